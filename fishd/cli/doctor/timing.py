"""Checks of the causes of late ticks, and of the clock that stamps ticks."""

import ctypes
import getpass
import re
import resource
import subprocess

from fishd.cli.doctor.base import Context
from fishd.core.process import safe_path
from fishd.core.process.realtime import required_priority_limit
from fishd.core.robots import RobotKind
from fishd.hardware.checks import Check, Result, ok, on_this_machine, skipped, warning

_TRIAL = "import os, sys; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(int(sys.argv[1])))"
_LIMITS_FILE = "/etc/security/limits.d/fishd.conf"
SUFFICIENT_LOCKED_BYTES = 512 * 2**20
"""Limit on locked memory that suffices for fishd [bytes]."""
SERVICE_PRIORITY_LIMIT = 51
"""LimitRTPRIO= of the installed fishd.service."""
_CAP_IPC_LOCK = 14
_UNSYNCHRONISED = 0x40
_TIME_ERROR = 5


def realtime(context: Context) -> Result:
    """Check real-time scheduling: try it in a process that ends at once."""
    priority = context.config.realtime.priority
    if not priority:
        return ok("not asked for (realtime.priority: 0)")
    if context.running:
        if context.running.status.realtime:
            return ok("the running fishd has real-time scheduling")
        return warning("the running fishd has no real-time scheduling", _allow_priority(priority))
    if _is_permitted(priority):
        above = required_priority_limit(priority)
        if _is_permitted(above):
            return ok(f"SCHED_FIFO {priority} is permitted")
        return warning(
            f"SCHED_FIFO {priority} is permitted, but not {above}, which the thread needs that "
            "ends a fishd that hangs",
            _allow_priority(priority),
        )
    return warning(
        f"user {getpass.getuser()} may not use SCHED_FIFO {priority}: ticks come late under load",
        _allow_priority(priority),
    )


def _is_permitted(priority: int) -> bool:
    command = safe_path.python_command("-I", "-S", "-c", _TRIAL, str(priority))
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def memory(context: Context) -> Result:
    """Check that memory may be locked, so that no tick waits for the disk."""
    if not context.config.realtime.lock_memory:
        return ok("not to be locked (realtime.lock_memory: false)")
    if context.running:
        state = context.text(f"/proc/{context.running.status.pid}/status")
        if re.search(r"^VmLck:\s+[1-9]", state, re.MULTILINE):
            return ok("the running fishd has locked its memory")
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    capabilities = [
        int(line.split()[1], 16)
        for line in context.text("/proc/self/status").splitlines()
        if line.startswith("CapEff:")
    ]
    privileged = any(mask >> _CAP_IPC_LOCK & 1 for mask in capabilities)
    if privileged or limit == resource.RLIM_INFINITY or limit >= SUFFICIENT_LOCKED_BYTES:
        return ok("may be locked")
    return warning(
        f"user {getpass.getuser()} may lock only {limit // 1024} kB of memory: a tick may wait for "
        "the disk",
        _allow("memlock unlimited"),
    )


def governor(context: Context) -> Result:
    """Check the governor: a processor that first has to speed up makes ticks late."""
    names = {
        context.text(f"/sys/devices/system/cpu/{cpu.parent.name}/cpufreq/scaling_governor")
        for cpu in context.path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq")
    } - {""}
    if not names:
        return skipped("this machine does not say how it chooses its speed")
    if names == {"performance"}:
        return ok("performance")
    return warning(
        f"{', '.join(sorted(names))}: the processor slows down between ticks",
        "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor "
        "(cpufrequtils makes it last)",
    )


def clock(context: Context) -> Result:
    """Check the clock: ticks have unix time, and a Pi without a network starts in the past."""
    if context.path("/run/systemd/timesync/synchronized").exists() or _kernel_is_synchronised():
        return ok("synchronised")
    return warning(
        "the clock is not synchronised: times in telemetry and files may be wrong",
        "sudo timedatectl set-ntp true, and see 'timedatectl'; or set it by hand",
    )


def _kernel_is_synchronised() -> bool:
    # struct timex: modes, padded to a long, four longs, then status; zero modes only ask.
    timex = ctypes.create_string_buffer(512)
    state = ctypes.CDLL(None).adjtimex(timex)
    at = 5 * ctypes.sizeof(ctypes.c_long)
    status = ctypes.c_int.from_buffer(timex, at).value
    return 0 <= state < _TIME_ERROR and not status & _UNSYNCHRONISED


def _allow_priority(priority: int) -> str:
    needed = required_priority_limit(priority)
    extra = f" with LimitRTPRIO={needed} (sudo systemctl edit fishd)"
    return _allow(f"rtprio {needed}", extra if needed > SERVICE_PRIORITY_LIMIT else "")


def _allow(limit: str, more: str = "") -> str:
    return f"run fishd as its systemd service{more}, or allow '{limit}' in {_LIMITS_FILE}"


def _is_real_time(kind: type[RobotKind]) -> bool:
    return kind.is_real_time  # else no tick can be late


CHECKS = (
    Check("real time", realtime, _is_real_time),
    Check("memory", memory, _is_real_time),
    Check("governor", governor, on_this_machine),
    Check("clock", clock),
)
