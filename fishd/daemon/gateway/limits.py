"""Limits of a gateway's process. When it exceeds one, it ends, and a new process begins."""

import ctypes
import os
import resource
import time
from contextlib import suppress
from typing import IO, Literal

_PAGE = resource.getpagesize()
_NICE = 5
"""Nice value of a gateway, and by how much it is nicer than a fishd that is below 0."""
_PAUSE = 0.1
"""Time between two looks at what is used [s]."""
_MOST_FILES = 4096
"""File descriptors, where the system permits that many: more than connections can be made between
two looks."""
_SPARE_FILES = 16
"""Kept free: ZeroMQ cannot refuse a connection for which there is no file descriptor."""
_TRIM = 8 * 2**20
"""Of memory more than at the start, unused parts are given back [bytes]."""
_TRIM_PAUSE = 2.0
"""Shortest time between two times of that [s]."""


class ResourceLimits:
    """The limits of this process, and how far they are used."""

    def __init__(self, memory: int, connections: int) -> None:
        """Take them; to be called once everything is loaded.

        memory: what it may take beyond what it has now [bytes]
        connections: file descriptors beyond those that are open now
        """
        _stand_back()
        with suppress(OSError), _own("oom_score_adj", "wb") as file:
            file.write(b"500")  # rather than fishd
        highest = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        files = _MOST_FILES if highest == resource.RLIM_INFINITY else min(_MOST_FILES, highest)
        resource.setrlimit(resource.RLIMIT_NOFILE, (files, highest))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        # The kernel enforces twice of it, also between two looks.
        highest = resource.getrlimit(resource.RLIMIT_DATA)[1]
        most = _data() + 2 * memory
        if highest != resource.RLIM_INFINITY:
            most = min(most, highest)
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))
        self._memory = _resident() + memory
        self._trim = _resident() + _TRIM
        self._files = min(_files() + connections, max(_files(), files - _SPARE_FILES))
        self._next_look = self._next_trim = 0.0

    def exceeded(self) -> str:
        """Which limit is exceeded, in words; empty for none. Cheap enough for every message."""
        now = time.monotonic()
        if now < self._next_look:
            return ""
        self._next_look = now + _PAUSE
        if (files := _files()) > self._files:
            return f"it had {files} connections, more than {self._files}"
        used = _resident()
        if used > self._trim and now > self._next_trim:
            self._next_trim = now + _TRIM_PAUSE
            ctypes.CDLL(None).malloc_trim(0)
            used = _resident()
        if used > self._memory:
            return f"it used {used / 2**20:.0f} MB, more than {self._memory / 2**20:.0f} MB"
        return ""


def _stand_back() -> None:
    """Take a lower priority than fishd, whose priority this process was forked with."""
    os.setpriority(os.PRIO_PROCESS, 0, _behind(os.getpriority(os.PRIO_PROCESS, 0)))


def _behind(fishd: int) -> int:
    """Return the nice value of a gateway, from that of fishd.

    That of a fishd that goes before others goes before them as well.
    """
    return max(fishd, min(_NICE, fishd + _NICE))


def _files() -> int:
    return len(list(os.scandir("/proc/self/fd")))


def _resident() -> int:
    return _memory(1)


def _data() -> int:
    return _memory(5)


def _memory(number: int) -> int:
    with _own("statm", "rb") as file:
        return int(file.read().split()[number]) * _PAGE


def _own(name: str, mode: Literal["rb", "wb"]) -> IO[bytes]:
    """A file of the kernel about this process; pathlib takes longer to load than all of it."""
    return open(f"/proc/self/{name}", mode)  # noqa: PTH123
