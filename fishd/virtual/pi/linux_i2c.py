"""Replacement of /dev/i2c-N in this process, below Adafruit_PureIO.

`ExtendedI2C`, Blinka and PureIO run on it unchanged. Other buses remain real.
"""

import ctypes
import errno
import fcntl
import io
import os
import threading
import weakref
from collections.abc import Callable, Sequence
from typing import Any

from fishd.virtual.pi.i2c import Message, Read, Write, kernel_error

I2C_TIMEOUT = 0x0702
I2C_SLAVE = 0x0703
I2C_RDWR = 0x0707
I2C_M_RD = 0x0001
"""Requests and flag of linux/i2c-dev.h that drivers use."""

MAX_MESSAGES = 42
"""Largest number of messages in one transfer of the kernel."""

_FOLDER = "/dev/i2c-"
_emulated: dict[str, "LinuxI2c"] = {}
_open_devices: "weakref.WeakValueDictionary[int, _Device]" = weakref.WeakValueDictionary()
_lock = threading.Lock()


class LinuxI2c:
    """Device files of emulated buses; also a context manager.

    While one is installed, the names `open` and `ioctl` of Adafruit_PureIO.smbus and `path` of
    adafruit_extended_bus are replaced in this process.
    """

    def __init__(
        self,
        transfer: Callable[[int, Sequence[Message]], list[bytes]],
        buses: set[int],
        set_timeout: Callable[[float], None],
    ) -> None:
        """
        transfer: returns the bytes of each read, given address and messages; raises OSError
        buses: N of each /dev/i2c-N
        set_timeout: sets the time after which the kernel gives up on a hanging bus [s]
        """
        self.transfer = transfer
        self.set_timeout = set_timeout
        self._paths = {f"{_FOLDER}{bus}" for bus in buses}

    def install(self) -> None:
        """Install the device files; raises ValueError if a bus is already emulated."""
        with _lock:
            for path in sorted(self._paths & _emulated.keys()):
                raise ValueError(f"{path} is emulated already: remove the other one first")
            if not _emulated:
                _replace_names()
            _emulated.update(dict.fromkeys(self._paths, self))

    def remove(self) -> None:
        """Remove the device files, like an unplugged adapter; may be called twice."""
        with _lock:
            own_paths = [path for path, owner in _emulated.items() if owner is self]
            for path in own_paths:
                del _emulated[path]
            if own_paths and not _emulated:
                _restore_names()

    def __enter__(self) -> "LinuxI2c":
        self.install()
        return self

    def __exit__(self, *_: object) -> None:
        self.remove()


class _Device(io.FileIO):
    """Open /dev/i2c-N. It opens /dev/null, so that its file descriptor is real."""

    def __init__(self, path: str, owner: LinuxI2c) -> None:
        super().__init__(os.devnull, "r+b")
        self._path = path
        self._owner = owner
        self._address = 0
        _open_devices[self.fileno()] = self

    def read(self, size: int | None = -1, /) -> bytes:
        return self._transfer(self._address, [Read(size or 0)])[0]

    def write(self, data: Any, /) -> int:
        content = bytes(data)
        self._transfer(self._address, [Write(content)])
        return len(content)

    def close(self) -> None:
        if not self.closed:
            _open_devices.pop(self.fileno(), None)
        super().close()

    def control(self, request: int, argument: Any) -> int:
        """Perform an ioctl."""
        if request == I2C_SLAVE:
            if not 0 <= argument <= 0x7F:
                raise kernel_error(errno.EINVAL)
            self._address = argument
        elif request == I2C_TIMEOUT:
            self._owner.set_timeout(argument * 0.01)
        elif request == I2C_RDWR:
            self._transfer_combined(argument)
        else:
            raise kernel_error(errno.ENOTTY)
        return 0

    def _transfer_combined(self, request: Any) -> None:
        """Perform the transfer of an i2c_rdwr_ioctl_data, and fill the buffers of its reads."""
        count = request.nmsgs
        if not 0 < count <= MAX_MESSAGES:
            raise kernel_error(errno.EINVAL)
        requested = [request.msgs[index] for index in range(count)]
        if any(
            message.flags & ~I2C_M_RD or message.addr != requested[0].addr for message in requested
        ):
            raise kernel_error(errno.EOPNOTSUPP)
        replies = iter(
            self._transfer(requested[0].addr, [_decode(message) for message in requested])
        )
        for message in requested:
            if message.flags & I2C_M_RD:
                reply = next(replies)
                ctypes.memmove(message.buf, reply, min(message.len, len(reply)))

    def _transfer(self, address: int, messages: Sequence[Message]) -> list[bytes]:
        self.fileno()  # raises ValueError if closed, as for any file
        if _emulated.get(self._path) is not self._owner:
            raise kernel_error(errno.ENODEV)
        return self._owner.transfer(address, messages)


class _Path:
    """Replacement of os.path in which the emulated device files exist."""

    @staticmethod
    def exists(path: str) -> bool:
        return path in _emulated or os.path.exists(path)  # noqa: PTH110, it replaces this

    def __getattr__(self, name: str) -> Any:
        return getattr(os.path, name)


def _decode(message: Any) -> Message:
    if message.flags & I2C_M_RD:
        return Read(message.len)
    return Write(ctypes.string_at(message.buf, message.len) if message.len else b"")


def _open(path: Any, *arguments: Any, **options: Any) -> Any:
    owner = _emulated.get(path)
    if owner is not None:
        return _Device(path, owner)
    return open(path, *arguments, **options)  # noqa: PTH123, it replaces this


def _ioctl(file: Any, request: int, argument: Any = 0, mutate: bool = True) -> Any:
    number = file if isinstance(file, int) else file.fileno()
    device = _open_devices.get(number)
    if device is None:
        return fcntl.ioctl(file, request, argument, mutate)
    return device.control(request, argument)


def _replace_names() -> None:
    # Imported here, so that a machine without the driver libraries can import this module.
    import adafruit_extended_bus
    from Adafruit_PureIO import smbus

    smbus.open = _open
    smbus.ioctl = _ioctl
    adafruit_extended_bus.path = _Path()


def _restore_names() -> None:
    import adafruit_extended_bus
    from Adafruit_PureIO import smbus

    del smbus.open
    smbus.ioctl = fcntl.ioctl
    adafruit_extended_bus.path = os.path
