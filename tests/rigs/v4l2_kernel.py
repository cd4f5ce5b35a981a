"""V4L2 camera emulated below linuxpy: open, ioctl and mmap of one device file.

As a program it is `fishd-camera` with that camera: rigs/v4l2_kernel.py FAULTS ARGUMENTS...
FAULTS is a JSON file with the faults of the camera, which a test may write at any time.
"""

import errno
import fcntl
import mmap
import os
import sys
import threading
import time
from collections import deque
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import linuxpy.io
import linuxpy.ioctl
import linuxpy.video.device
import msgspec
import numpy as np
import simplejpeg
from linuxpy.video import raw
from linuxpy.video.raw import IOC

DEVICE = "/dev/video7"
BUFFER = 2**20
FORMATS = ("MJPG", "YUYV", "GREY")
TICKS_OF_EXPOSURE = 100e-6
LEVELS = 18


class Faults(msgspec.Struct, frozen=True):
    """Faults of the camera; the defaults are none."""

    unplugged: bool = False
    denied: bool = False
    busy: bool = False
    stalled: bool = False
    broken: bool = False
    """Whether its JPEGs are cut off."""
    garbage: bool = False
    """Whether it sends random bytes."""
    realtime_stamps: bool = False
    """Whether time stamps are not those of the monotonic clock."""
    late: int = 0
    """Number of frames with time stamps that are 3 s old."""
    end_of_frame: bool = False
    formats: tuple[str, ...] = FORMATS
    rate: float | None = None
    """Only available rate [1/s]; None: any rate."""
    skip: int = 0
    """Number of frames of which one is lost between camera and kernel; 0: none."""
    no_video: bool = False
    """Whether the device is for metadata."""


class Control:
    def __init__(self, name: str, kind: Any, low: int, high: int, value: int) -> None:
        self.name, self.kind, self.low, self.high, self.value = name, kind, low, high, value


def _controls() -> dict[int, Control]:
    ids, kinds = raw.ControlID, raw.CtrlType
    return {
        int(ids.GAIN): Control("Gain", kinds.INTEGER, 0, 100, 10),
        int(ids.EXPOSURE_AUTO): Control("Auto Exposure", kinds.MENU, 0, 3, 3),
        int(ids.EXPOSURE_ABSOLUTE): Control("Exposure Time, Absolute", kinds.INTEGER, 1, 5000, 200),
    }


class V4l2Camera:
    """Camera with its driver, and the light on it."""

    def __init__(self, faults: Path) -> None:
        self._file = faults
        self.faults = Faults()
        self._lock = threading.RLock()
        self._memory = os.memfd_create("buffers")
        self._event: int | None = None
        self._ours: int | None = None
        self._gone: set[int] = set()
        """Descriptors that were open when the camera was unplugged."""
        self._format = ("MJPG", 640, 480)
        self._rate = 30.0
        self._controls = _controls()
        self._queued: deque[int] = deque()
        self._done: deque[Any] = deque()
        self._buffers = 0
        self._streaming = False
        self._sequence = -1
        self._late = 0
        self._start_reading()
        threading.Thread(target=self._live, daemon=True).start()

    def plug_in(self) -> None:
        """Install the camera below linuxpy."""
        own = {"open": self.open, "O_NONBLOCK": os.O_NONBLOCK, "O_CLOEXEC": os.O_CLOEXEC}
        linuxpy.io.os = SimpleNamespace(**own)
        linuxpy.ioctl.fcntl = SimpleNamespace(ioctl=self.ioctl)
        linuxpy.video.device.mmap = SimpleNamespace(mmap=self.mmap)

    def open(self, path: Any, flags: int) -> int:
        if str(path) != DEVICE:
            return os.open(path, flags)
        with self._lock:
            self._read_faults()
            if self.faults.unplugged:
                raise OSError(errno.ENOENT, "No such file or directory")
            if self.faults.denied:
                raise PermissionError(errno.EACCES, "Permission denied")
            self._streaming, self._buffers = False, 0
            self._queued.clear()
            self._done.clear()
            # Readable once per frame; FileIO closes it.
            self._event = os.eventfd(0, os.EFD_SEMAPHORE | os.EFD_NONBLOCK)
            self._gone.discard(self._event)
            if self._ours is not None:
                os.close(self._ours)
            self._ours = os.dup(self._event)  # keeps the number of the descriptor reserved
            return self._event

    def mmap(self, descriptor: int, length: int, offset: int = 0) -> mmap.mmap:
        if descriptor != self._event:
            return mmap.mmap(descriptor, length, offset=offset)
        os.ftruncate(self._memory, 64 * BUFFER)
        return mmap.mmap(self._memory, length, offset=offset)

    def ioctl(self, file: Any, request: int, argument: Any = None) -> int:
        descriptor = file if isinstance(file, int) else file.fileno()
        with self._lock:
            if descriptor != self._event:
                return fcntl.ioctl(descriptor, request, argument)
            if self.faults.unplugged or descriptor in self._gone:
                raise OSError(errno.ENODEV, "No such device")
            handler = getattr(self, f"_{IOC(request).name.lower()}", None)
            if handler is None:
                raise OSError(errno.ENOTTY, "Inappropriate ioctl for device")
            handler(argument)
        return 0

    def _querycap(self, argument: Any) -> None:
        argument.driver, argument.card = b"emulated", b"Emulated camera"
        kind = raw.Capability.META_CAPTURE if self.faults.no_video else raw.Capability.VIDEO_CAPTURE
        argument.device_caps = argument.capabilities = int(kind | raw.Capability.STREAMING)

    def _enum_fmt(self, argument: Any) -> None:
        if self.faults.no_video or argument.index >= len(self.faults.formats):
            raise OSError(errno.EINVAL, "Invalid argument")
        argument.pixelformat = raw.v4l2_fourcc(*self.faults.formats[argument.index])

    def _s_fmt(self, wanted: Any) -> None:
        if self.faults.no_video:
            raise OSError(errno.EINVAL, "Invalid argument")
        if self.faults.busy:
            raise OSError(errno.EBUSY, "Device or resource busy")
        pix = wanted.fmt.pix
        fourcc = linuxpy.video.device.human_pixel_format(pix.pixelformat)
        if fourcc not in self.faults.formats:
            fourcc = self.faults.formats[0]
        self._format = (fourcc, min(1280, pix.width), min(720, pix.height))
        self._g_fmt(wanted)

    def _g_fmt(self, argument: Any) -> None:
        fourcc, width, height = self._format
        pix = argument.fmt.pix
        pix.pixelformat, pix.width, pix.height = raw.v4l2_fourcc(*fourcc), width, height
        pix.bytesperline = {"YUYV": 2 * width, "GREY": width + 16}.get(fourcc, 0)
        pix.sizeimage = BUFFER

    def _s_parm(self, wanted: Any) -> None:
        time_per_frame = wanted.parm.capture.timeperframe
        rate = self.faults.rate or time_per_frame.denominator / time_per_frame.numerator
        self._rate = rate
        self._g_parm(wanted)

    def _g_parm(self, argument: Any) -> None:
        argument.parm.capture.timeperframe.numerator = 1000
        argument.parm.capture.timeperframe.denominator = round(1000 * self._rate)

    def _query_ext_ctrl(self, argument: Any) -> None:
        after = argument.id & ~int(raw.ControlFlag.NEXT_CTRL | raw.ControlFlag.NEXT_COMPOUND)
        later = [number for number in sorted(self._controls) if number > after]
        if not later:
            raise OSError(errno.EINVAL, "Invalid argument")
        control = self._controls[later[0]]
        argument.id, argument.type = later[0], int(control.kind)
        argument.name = control.name.encode()
        argument.minimum, argument.maximum, argument.step = control.low, control.high, 1
        argument.elems, argument.elem_size, argument.flags = 1, 4, 0

    def _querymenu(self, argument: Any) -> None:
        if argument.index not in (1, 3):
            raise OSError(errno.EINVAL, "Invalid argument")
        argument.m1.name = {1: b"Manual Mode", 3: b"Aperture Priority Mode"}[argument.index]

    def _g_ext_ctrls(self, argument: Any) -> None:
        control = argument.controls[0]
        control.m1.value = self._controls[control.id].value

    def _s_ext_ctrls(self, wanted: Any) -> None:
        control = wanted.controls[0]
        auto = self._controls[int(raw.ControlID.EXPOSURE_AUTO)].value
        if control.id == int(raw.ControlID.EXPOSURE_ABSOLUTE) and auto != 1:
            raise OSError(errno.EACCES, "Permission denied")
        self._controls[control.id].value = control.m1.value

    def _reqbufs(self, wanted: Any) -> None:
        if wanted.count and self.faults.busy:
            raise OSError(errno.EBUSY, "Device or resource busy")
        self._buffers = wanted.count = min(wanted.count, 32)

    def _querybuf(self, argument: Any) -> None:
        argument.length, argument.m.offset = BUFFER, argument.index * BUFFER

    def _qbuf(self, given: Any) -> None:
        # Like vb2: the buffer of the caller loses the data of its frame.
        given.sequence = given.flags = 0
        given.timestamp.secs = given.timestamp.usecs = 0
        self._queued.append(given.index)

    def _dqbuf(self, argument: Any) -> None:
        if not self._done:
            raise BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable")
        assert self._ours is not None
        os.eventfd_read(self._ours)
        index, size, sequence, stamp, flags = self._done.popleft()
        argument.index, argument.bytesused = index, size
        argument.sequence, argument.flags = sequence, flags
        argument.timestamp.secs, argument.timestamp.usecs = divmod(round(stamp * 1e6), 10**6)

    def _streamon(self, _: Any) -> None:
        self._streaming, self._sequence = True, -1

    def _streamoff(self, _: Any) -> None:
        self._streaming = False
        self._queued.clear()
        self._done.clear()

    def _start_reading(self) -> None:
        self._content = b""
        self._read_faults()

    def _read_faults(self) -> None:
        try:
            content = self._file.read_bytes()
            if content == self._content:
                return
            self.faults = msgspec.json.decode(content, type=Faults)
        except (OSError, msgspec.DecodeError):
            return
        self._content = content
        self._late = self.faults.late
        if self.faults.unplugged and self._event is not None and self._ours is not None:
            self._gone.add(self._event)
            self._streaming = False
            os.eventfd_write(self._ours, 1)  # poll returns, as for an error

    def _live(self) -> None:
        due = time.monotonic()
        while True:
            due = max(due + 1.0 / self._rate, time.monotonic() - 0.1)
            time.sleep(max(0.0, due - time.monotonic()))
            with self._lock:
                self._read_faults()
                if self._streaming and not (self.faults.stalled or self.faults.unplugged):
                    self._expose()

    def _expose(self) -> None:
        faults = self.faults
        self._sequence += 1
        if (faults.skip and self._sequence % faults.skip == 0) or not self._queued:
            return
        index, data = self._queued.popleft(), self._picture()
        if len(data) > BUFFER:
            raise AssertionError("a picture is larger than its buffer")
        with mmap.mmap(self._memory, BUFFER, offset=index * BUFFER) as memory:
            memory[: len(data)] = data
        exposure = self._controls[int(raw.ControlID.EXPOSURE_ABSOLUTE)].value * TICKS_OF_EXPOSURE
        begun = time.monotonic() - exposure - 0.005
        stamp = begun + exposure if faults.end_of_frame else begun
        flags = 0x2000 | (0 if faults.end_of_frame else 0x10000)
        if self._late:
            self._late -= 1
            stamp -= 3.0
        if faults.realtime_stamps:
            stamp, flags = time.time(), 0x10000
        self._done.append((index, len(data), self._sequence, stamp, flags))
        assert self._ours is not None
        os.eventfd_write(self._ours, 1)

    def _picture(self) -> bytes:
        if self.faults.garbage and self._format[0] == "MJPG":
            return os.urandom(5000)
        data = encoded(self._sequence % LEVELS, *self._format)
        if self._format[0] != "MJPG":
            return data
        if self.faults.broken:
            return data[: len(data) // 2]
        return data


def level(number: int) -> int:
    """Return the grey level of the left half of a picture."""
    return 40 + 10 * (number % LEVELS)


def picture(number: int, width: int, height: int) -> "np.ndarray[Any, np.dtype[np.uint8]]":
    """Return a picture whose left half encodes its number, with a black upper right quarter."""
    picture = np.full((height, width), 250, np.uint8)
    picture[:, : width // 2] = level(number)
    picture[: height // 2, width // 2 :] = 0
    return picture


@cache
def encoded(number: int, fourcc: str, width: int, height: int) -> bytes:
    """Return a picture in the format of the camera."""
    grey = picture(number, width, height)
    if fourcc == "GREY":
        return b"".join(bytes(line) + bytes(16) for line in grey)
    if fourcc == "YUYV":
        lines = np.full((height, 2 * width), 128, np.uint8)
        lines[:, ::2] = grey
        return lines.tobytes()
    data: bytes = simplejpeg.encode_jpeg(grey[:, :, np.newaxis], 90, colorspace="GRAY")
    return data


if __name__ == "__main__":
    from fishd.camera.main import main

    V4l2Camera(Path(sys.argv.pop(1))).plug_in()
    main()
