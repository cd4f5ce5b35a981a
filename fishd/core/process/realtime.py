"""Settings of the operating system and the interpreter for a loop with deadlines."""

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
_SWITCH_INTERVAL_S = 2e-4
"""Maximum time that another thread may keep the interpreter while the loop waits for it [s]."""

_libc = ctypes.CDLL(None, use_errno=True)


def enter(priority: int, lock_memory: bool) -> bool:
    """Prepare this thread and process for the loop; return whether it has real-time scheduling.

    Settings that are not permitted are skipped with one warning. Call it once everything is loaded,
    from the thread that ticks.
    """
    _libc.prctl(_PR_SET_TIMERSLACK, 1)  # wake up on time, not up to 50 µs later
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    problems = []
    if lock_memory and _libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        problems.append(f"memory is not locked ({os.strerror(ctypes.get_errno())})")
    scheduled = False
    if priority:
        try:
            # Threads that are started later, for example to load a controller, must not inherit
            # this.
            policy = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            os.sched_setscheduler(0, policy, os.sched_param(priority))
            for thread in Path("/proc/self/task").iterdir():
                if int(thread.name) != threading.get_native_id():
                    _keep_running(int(thread.name), priority - 1)
            scheduled = True
        except OSError as error:
            problems.append(f"no real-time scheduling ({error.strerror})")
    if problems:
        log.warning(
            "%s: ticks will be late under load; %s, or set realtime.priority: 0 and "
            "realtime.lock_memory: false to accept that",
            " and ".join(problems),
            "run as the systemd service" if scheduled else _remedy(priority),
        )
    return scheduled


def drop_priority() -> None:
    """Drop the real-time priority of this thread; call it once no deadline is left.

    A thread that reaps a process at that priority may spin in the kernel (Linux,
    `shrink_dcache_parent`) and occupy its processor for up to a second, until the process, which it
    has preempted, has left /proc.
    """
    policy = os.SCHED_OTHER | os.SCHED_RESET_ON_FORK  # without the flag, only root may do this
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, policy, os.sched_param(0))


def raise_priority(thread: int, priority: int) -> None:
    """Let a thread preempt a loop of this priority, so that it can end fishd when the loop hangs.

    An endless loop would otherwise occupy its processor. If this is not permitted, log one warning
    with the remedy.
    """
    needed = required_priority_limit(priority)
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


def required_priority_limit(priority: int) -> int:
    """Return the required RLIMIT_RTPRIO: one above the loop, for the thread that can end it."""
    return min(priority + 1, os.sched_get_priority_max(os.SCHED_FIFO))


def _remedy(priority: int) -> str:
    limit, _ = resource.getrlimit(resource.RLIMIT_RTPRIO)
    if 0 < limit < priority:
        return (
            f"let LimitRTPRIO= of its service be {required_priority_limit(priority)}, not {limit}"
        )
    return "run as the systemd service"


def _keep_running(thread: int, priority: int) -> None:
    """Raise the priority of a thread that may hold the interpreter above ordinary programs.

    The loop has to wait for such a thread, however high its own priority is.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(thread, os.SCHED_FIFO, os.sched_param(max(1, priority)))


def freeze_garbage_collector() -> None:
    """Exempt all existing objects from garbage collection; `collect_garbage` collects later ones.

    Return free memory to the system.
    """
    gc.collect()
    _libc.malloc_trim(0)
    gc.freeze()
    gc.disable()


def collect_garbage(*, thorough: bool = False) -> None:
    """Free unreachable objects; call it between ticks.

    thorough: search all objects, not only those created since the last two calls; a controller may
        have created a million objects, whose search takes longer than a tick
    """
    gc.collect(2 if thorough else 1)
