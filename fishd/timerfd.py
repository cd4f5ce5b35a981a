"""A Linux timer that is a file descriptor, so that an event loop can wait for it.

Python has os.timerfd_create only from 3.13 on; the C library has it everywhere.
"""

import contextlib
import ctypes
import os

_CLOCK_MONOTONIC = 1
_ABSOLUTE = 1


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("interval", _Timespec), ("value", _Timespec))


_libc = ctypes.CDLL(None, use_errno=True)


def _checked(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


class TimerFd:
    """One-shot timer on CLOCK_MONOTONIC; raises OSError where the kernel refuses."""

    def __init__(self) -> None:
        self._fd = _checked(_libc.timerfd_create(_CLOCK_MONOTONIC, os.O_NONBLOCK | os.O_CLOEXEC))
        self._spec = _Itimerspec()

    def fileno(self) -> int:
        """The descriptor, which is readable once the timer has expired."""
        return self._fd

    def arm(self, deadline: float) -> None:
        """Expire at `deadline` [s, monotonic]; at once when that has passed."""
        seconds = int(deadline)
        value = self._spec.value
        value.seconds = seconds
        value.nanoseconds = max(1, int((deadline - seconds) * 1e9))  # all zero would disarm
        _checked(_libc.timerfd_settime(self._fd, _ABSOLUTE, ctypes.byref(self._spec), None))

    def clear(self) -> None:
        """Make the descriptor unreadable again."""
        with contextlib.suppress(BlockingIOError):
            os.read(self._fd, 8)

    @property
    def closed(self) -> bool:
        """True after close()."""
        return self._fd < 0

    def close(self) -> None:
        """Give the descriptor back; may be called twice."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
