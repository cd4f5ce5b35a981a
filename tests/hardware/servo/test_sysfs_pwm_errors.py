"""The servo on the kernel's PWM when single writes and reads fail: no step skips the next."""

import errno
import os
from typing import Any

import pytest
from rigs.sysfs_pwm_kernel import SysfsPwm
from rigs.sysfs_pwm_rig import PI5, Bench

from fishd.core.errors import ServoError

NEUTRAL = 1_500_000


class BrokenPwm(SysfsPwm):
    """A kernel that fails at some files: at every read, or when it is sent a certain number."""

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        self.unwritable: set[tuple[str, int]] = set()
        self.unreadable: set[str] = set()
        self._names: dict[int, str] = {}

    def open(self, path: str, flags: int, /) -> int:
        fd = super().open(path, flags)
        self._names[fd] = path.rpartition("/")[2]
        return fd

    def pread(self, fd: int, length: int, offset: int, /) -> bytes:
        if self._names[fd] in self.unreadable:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return super().pread(fd, length, offset)

    def pwrite(self, fd: int, data: bytes, offset: int, /) -> int:
        if (self._names[fd], int(data)) in self.unwritable:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return super().pwrite(fd, data, offset)


class BrokenBench(Bench):
    """Such a kernel, with the pulses of a fishd at 0.5 rad on it."""

    def __init__(self) -> None:
        super().__init__({PI5: 4}, kernel=BrokenPwm)
        self.fishd = self.servo()
        self.fishd.write(0.5)
        self.clock.sleep(0.1)
        assert self.width() == 1800.0

    def width(self, channel: int = 2, device: str = PI5) -> float:
        """The pulse two periods from now [µs]."""
        self.clock.sleep(0.04)
        return super().width(channel, device)


@pytest.fixture
def bench() -> BrokenBench:
    return BrokenBench()


@pytest.mark.parametrize(
    "unwritable",
    [
        {("duty_cycle", NEUTRAL)},
        {("duty_cycle", 0)},
        {("duty_cycle", NEUTRAL), ("duty_cycle", 0)},
        {("enable", 0)},
    ],
)
def test_the_last_resort_ends_pulses_whatever_fails(
    bench: BrokenBench, unwritable: set[tuple[str, int]]
) -> None:
    bench.kernel.unwritable = unwritable
    with pytest.raises(ServoError, match="Input/output error"):
        bench.last_resort()
    assert bench.width() == 0.0


def test_the_last_resort_stops_the_pulses_though_the_user_is_impatient(bench: BrokenBench) -> None:
    sleep = bench.clock.sleep

    def interrupt(seconds: float) -> None:
        bench.clock.sleep = sleep  # type: ignore[method-assign]
        raise KeyboardInterrupt

    bench.clock.sleep = interrupt  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        bench.last_resort()
    assert bench.width() == 0.0


@pytest.mark.parametrize(
    "broken",
    [
        {"unreadable": {"duty_cycle"}},
        {"unreadable": {"enable"}},
        {"unwritable": {("duty_cycle", 0)}},
    ],
    ids=str,
)
def test_close_ends_a_channel_that_cannot_be_released(
    bench: BrokenBench, broken: dict[str, Any]
) -> None:
    vars(bench.kernel).update(broken)
    with pytest.raises(ServoError, match="Input/output error"):
        bench.fishd.close()
    channel = bench.kernel._chips[PI5][2]
    assert channel.state.enable == 0
    assert bench.width() == 0.0
    assert channel.exported_at is None
