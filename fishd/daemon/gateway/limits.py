"""Limits of a gateway. When it exceeds one, it starts again."""

import ctypes
import os
import resource
import time
from contextlib import suppress
from typing import IO, Literal

_PAGE_BYTES = resource.getpagesize()
_NICE = 5
"""Difference of the nice value of a gateway to that of fishd."""
_CHECK_PERIOD_S = 0.1
"""Time between two checks of the limits [s]."""
_MAX_FILES = 4096
"""Largest number of file descriptors, if the system permits it.

More than the number of connections that clients can make between two checks.
"""
_SPARE_FILES = 16
"""Descriptors kept free: ZeroMQ cannot refuse a connection without a file descriptor for it."""
_TRIM_BYTES = 8 * 2**20
"""Growth of the memory since the start from which on unused parts are released [bytes]."""
_TRIM_PERIOD_S = 2.0
"""Shortest time between two such releases [s]."""


class ResourceLimits:
    """Limits of this process, and their present use."""

    def __init__(self, memory: int, connections: int) -> None:
        """Set the limits; call it after all imports.

        memory: memory permitted in addition to the present use [bytes]
        connections: file descriptors permitted in addition to those that are open
        """
        fishd = os.getpriority(os.PRIO_PROCESS, os.getppid())
        os.setpriority(os.PRIO_PROCESS, 0, fishd + _NICE)
        with suppress(OSError), _open_proc_file("oom_score_adj", "wb") as file:
            file.write(b"500")  # the kernel shall kill a gateway rather than fishd
        highest = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        files = _MAX_FILES if highest == resource.RLIM_INFINITY else min(_MAX_FILES, highest)
        resource.setrlimit(resource.RLIMIT_NOFILE, (files, highest))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        # The kernel enforces twice the limit, also between two checks.
        highest = resource.getrlimit(resource.RLIMIT_DATA)[1]
        max_data = _data_bytes() + 2 * memory
        if highest != resource.RLIM_INFINITY:
            max_data = min(max_data, highest)
        resource.setrlimit(resource.RLIMIT_DATA, (max_data, max_data))
        self._memory = _resident_bytes() + memory
        self._trim = _resident_bytes() + _TRIM_BYTES
        self._files = min(_files() + connections, max(_files(), files - _SPARE_FILES))
        self._next_check = self._next_trim = 0.0

    def exceeded(self) -> str:
        """Return a phrase that names the exceeded limit, or an empty text.

        Fast enough for a call with each message.
        """
        now = time.monotonic()
        if now < self._next_check:
            return ""
        self._next_check = now + _CHECK_PERIOD_S
        if (files := _files()) > self._files:
            return f"it had {files} connections, more than {self._files}"
        used = _resident_bytes()
        if used > self._trim and now > self._next_trim:
            self._next_trim = now + _TRIM_PERIOD_S
            ctypes.CDLL(None).malloc_trim(0)
            used = _resident_bytes()
        if used > self._memory:
            return f"it used {used / 2**20:.0f} MB, more than {self._memory / 2**20:.0f} MB"
        return ""


def _files() -> int:
    return len(list(os.scandir("/proc/self/fd")))


def _resident_bytes() -> int:
    return _memory(1)


def _data_bytes() -> int:
    return _memory(5)


def _memory(number: int) -> int:
    with _open_proc_file("statm", "rb") as file:
        return int(file.read().split()[number]) * _PAGE_BYTES


def _open_proc_file(name: str, mode: Literal["rb", "wb"]) -> IO[bytes]:
    """Open a file in /proc/self; pathlib would take longer to load than the whole module."""
    return open(f"/proc/self/{name}", mode)  # noqa: PTH123
