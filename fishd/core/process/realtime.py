"""Settings of the operating system and the interpreter for a loop that must be on time."""

import contextlib
import ctypes
import gc
import logging
import os
import resource
import sys
import threading
from pathlib import Path

log = logging.getLogger(__name__)

_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_SWITCH_INTERVAL = 2e-4
"""How long another thread may keep the interpreter once the loop wants it [s]."""

_libc = ctypes.CDLL(None, use_errno=True)


def enter(priority: int, lock_memory: bool) -> bool:
    """Prepare this thread and process for the loop; True when it got real-time scheduling.

    Skips what is not permitted, with one warning. Call it once everything is loaded, from the
    thread that ticks.
    """
    _libc.prctl(_PR_SET_TIMERSLACK, 1)  # wake up when asked, not up to 50 µs later
    sys.setswitchinterval(_SWITCH_INTERVAL)
    refused = []
    if lock_memory and _libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        refused.append(f"memory is not locked ({os.strerror(ctypes.get_errno())})")
    scheduled = False
    if priority:
        try:
            # Threads that are started later, to load a controller say, must not inherit this.
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(priority))
            for thread in Path("/proc/self/task").iterdir():
                if int(thread.name) != threading.get_native_id():
                    _keep_running(int(thread.name), priority - 1)
            scheduled = True
        except OSError as error:
            refused.append(f"no real-time scheduling ({error.strerror})")
    if refused:
        log.warning(
            "%s: ticks will be late under load; %s, or set realtime.priority: 0 and "
            "realtime.lock_memory: false to accept that",
            " and ".join(refused),
            "run as the systemd service" if scheduled else _remedy(priority),
        )
    return scheduled


def leave() -> None:
    """Give the real-time priority of this thread back; call it once nothing has to be on time.

    Who reaps a process at that priority may spin in the kernel (Linux, `shrink_dcache_parent`) for
    up to a second, until the process, which it has preempted, has left /proc; and the processor
    with it.
    """
    policy = os.SCHED_OTHER | os.SCHED_RESET_ON_FORK  # without the flag, only root may
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, policy, os.sched_param(0))


def outrank(thread: int, priority: int) -> None:
    """Let the thread that ends fishd where it hangs preempt a loop of this priority.

    A loop that computes for ever would keep its processor to itself. Where that is not permitted,
    one warning says what would be right.
    """
    needed = limit_for(priority)
    remedy = ""
    if needed == priority:
        remedy = f"set realtime.priority: {priority - 1}"
    try:
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(needed))
    except OSError:
        remedy = (
            f"let LimitRTPRIO= of its service be {needed}, or set realtime.priority: {priority - 1}"
        )
    if remedy:
        log.warning(
            "realtime.priority: %d is the highest that is permitted: a loop that hangs would keep "
            "the thread that ends fishd from running; %s",
            priority,
            remedy,
        )


def limit_for(priority: int) -> int:
    """Return the RLIMIT_RTPRIO that fishd needs: one above the loop is the thread that ends it."""
    return min(priority + 1, os.sched_get_priority_max(os.SCHED_FIFO))


def _remedy(priority: int) -> str:
    limit, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    if 0 < limit < priority:
        return f"let LimitRTPRIO= of its service be {limit_for(priority)}, not {limit}"
    return "run as the systemd service"


def _keep_running(thread: int, priority: int) -> None:
    """Let no ordinary program preempt a thread that may hold the interpreter.

    The loop would have to wait for it, however high its own priority is.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(max(1, priority)))


def quiet_garbage_collector() -> None:
    """Exempt all objects that exist now; later ones are collected only by `collect_garbage`.

    What the start has freed goes back to the system.
    """
    gc.collect()
    _libc.malloc_trim(0)
    gc.freeze()
    gc.disable()


def collect_garbage(*, thorough: bool = False) -> None:
    """Free what nothing leads to any more; call it between ticks.

    thorough: not only among what is new since the last two calls; a controller may have brought a
        million objects, which take longer to look through than a tick
    """
    gc.collect(2 if thorough else 1)
