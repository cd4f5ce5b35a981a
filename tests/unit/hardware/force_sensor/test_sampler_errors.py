"""Errors of the bus and the chip: messages and behaviour of the sampler during and after them."""

import gc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rigs.ads1115_board import ABSENT_BUS
from rigs.force_rig import STEP, ForceRig, take_pairs, volts

from fishd.hardware.sampler import MAX_PAUSE_S
from fishd.virtual.pi.linux_i2c import LinuxI2c


@pytest.mark.parametrize("delay", [0.0, 2e-3, 6e-3, 8.6e-3])
def test_a_reset_amid_a_conversion_gives_an_error_and_no_value(rig: ForceRig, delay: float) -> None:
    # These settings are those of the chip after a reset, so they do not reveal the reset.
    sampler = rig.sampler(data_rate=128, full_scale=2.048)
    take_pairs(sampler, rig, 0.1)
    sleep = rig.clock.sleep

    def break_down(seconds: float) -> None:
        if seconds < 1 / 128:  # not a conversion
            sleep(seconds)
            return
        sleep(delay)
        rig.faults.inject("brown-out")
        sleep(seconds - delay)

    rig.clock.sleep = break_down
    sampler.step()
    assert sampler.trouble == "the ADS1115 was reset while it converted: check its power"
    rig.clock.sleep = sleep
    pairs = take_pairs(sampler, rig, 0.5)
    assert sampler.trouble is None
    assert all(volts(pair) == pytest.approx((0.5, -0.25), abs=6 * STEP) for pair in pairs)
    assert len(pairs) > 15


def test_a_transfer_that_the_kernel_gave_up_without_an_exception_is_an_error(
    rig: ForceRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A raw file's write returns None for EAGAIN, which the driver would treat as success."""
    from Adafruit_PureIO import smbus

    emulated = smbus.open

    def as_python_does(*arguments: Any, **options: Any) -> Any:
        file = emulated(*arguments, **options)
        for name in ("read", "write"):
            setattr(file, name, _without_blocking_error(getattr(file, name)))
        return file

    monkeypatch.setattr(smbus, "open", as_python_does)
    sampler = rig.sampler()
    take_pairs(sampler, rig, 0.1)
    rig.faults.inject("arbitration-lost", 0.01)
    sampler.step()
    assert "error 11" in sampler.trouble
    pairs = take_pairs(sampler, rig, 0.5)
    assert all(volts(pair) == pytest.approx((0.5, -0.25), abs=6 * STEP) for pair in pairs)


def _without_blocking_error(call: Any) -> Any:
    def as_raw_file(argument: Any) -> Any:
        try:
            return call(argument)
        except BlockingIOError:
            return None

    return as_raw_file


def test_while_a_chip_is_away_pauses_between_attempts_grow_to_half_a_second(rig: ForceRig) -> None:
    sampler = rig.sampler()
    take_pairs(sampler, rig, 0.1)
    rig.faults.inject("unplugged")
    pauses = []
    for _ in range(20):
        sampler.step()
        pauses.append(sampler.ready_at - rig.clock.now)
    assert pauses[0] == pytest.approx(1.25 / 860 + 1e-3)
    assert pauses == pytest.approx(sorted(pauses))
    assert pauses[-1] == pytest.approx(MAX_PAUSE_S)
    rig.faults.clear()
    assert take_pairs(sampler, rig, 1.0)
    assert sampler.reconnects == 1


@pytest.mark.parametrize(
    ("fault", "line"),
    [
        ("nack", "nothing answers at 0x48 on /dev/i2c-1: check power and wires"),
        ("timeout", "/dev/i2c-1 hangs: check SDA and SCL"),
        ("clock-stretch", "a transfer on /dev/i2c-1 broke off"),
        ("bus-owned", "a kernel driver owns 0x48 on /dev/i2c-1: remove its dtoverlay"),
        ("arbitration-lost", "something else drives /dev/i2c-1"),
        ("unplugged", "nothing answers at 0x48 on /dev/i2c-1"),
        ("stuck-busy", "the ADS1115 stays busy: switch its power off and on"),
    ],
)
@pytest.mark.parametrize("from_the_start", [False, True])
def test_the_trouble_is_one_line_that_says_what_to_check(
    rig: ForceRig, fault: str, line: str, from_the_start: bool
) -> None:
    sampler = rig.sampler()
    if not from_the_start:
        take_pairs(sampler, rig, 0.1)
    rig.faults.inject(fault)
    for _ in range(6):
        sampler.step()
        assert "\n" not in sampler.trouble
    assert sampler.trouble.startswith(line)
    rig.faults.clear()
    assert take_pairs(sampler, rig, 1.0)
    assert sampler.trouble is None


def test_a_bus_that_is_missing_is_named_and_used_once_it_is_there() -> None:
    rig = ForceRig()
    sampler = rig.sampler(bus=ABSENT_BUS)
    for _ in range(5):
        sampler.step()
    assert sampler.trouble.startswith("/dev/i2c-201 does not exist: enable I2C")
    with rig, LinuxI2c(rig.bus.transfer, {2}, lambda seconds: None):
        assert take_pairs(sampler, rig, 1.0)
        rig.device.remove()
        sampler.step()
        assert sampler.trouble.startswith("/dev/i2c-201 has vanished")
        take_pairs(sampler, rig, 1.0)
        rig.device.install()
        assert take_pairs(sampler, rig, 1.0)


def leaves_garbage(function: Callable[[], object]) -> bool:
    """Return whether every call of a function leaves objects to the garbage collector.

    A single call may, because of something that another test left behind, such as a thread.
    """

    def leaves_some() -> bool:
        gc.collect()
        gc.disable()
        try:
            function()
            return gc.collect() > 0
        finally:
            gc.enable()

    return all(leaves_some() for _ in range(5))


@pytest.mark.parametrize("fault", ["stuck-busy", "nack"])
def test_opening_the_bus_again_and_again_leaves_nothing_behind(rig: ForceRig, fault: str) -> None:
    """This holds without the garbage collector, which does not run in the daemon's ticks."""
    sampler = rig.sampler()
    take_pairs(sampler, rig, 0.1)
    rig.faults.inject(fault)

    def open_again_and_again() -> None:
        before = len(list(Path("/proc/self/fd").iterdir()))
        for _ in range(100):
            sampler.step()
        assert len(list(Path("/proc/self/fd").iterdir())) <= before

    assert not leaves_garbage(open_again_and_again)


def test_sampling_leaves_no_garbage(rig: ForceRig) -> None:
    """The Adafruit driver's combined transfers leave thousands of objects per second."""
    sampler = rig.sampler()
    take_pairs(sampler, rig, 0.1)
    assert not leaves_garbage(lambda: take_pairs(sampler, rig, 1.0))


def test_a_hanging_bus_keeps_the_sampler_for_20_ms_not_the_kernels_second(rig: ForceRig) -> None:
    sampler = rig.sampler()
    take_pairs(sampler, rig, 0.1)
    rig.faults.inject("timeout")
    started = rig.clock.now
    sampler.step()
    assert rig.clock.now - started < 0.03
