"""The power of the servo in the ticks, and a power meter that fails."""

from collections.abc import Callable
from dataclasses import replace

import pytest
from msgspec import UNSET
from rigs.harness import Rig, Wrapped, fragile_rig

from fishd.core.errors import SensorError
from fishd.hardware.base import Robot


class Metered(Wrapped):
    """A robot with a scripted power meter."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self.meter: Callable[[float], float] = lambda now: 1.5

    def robot(self) -> Robot:
        return replace(super().robot(), power=lambda now: self.meter(now))


class Bare(Wrapped):
    """A robot without a power meter."""

    def robot(self) -> Robot:
        return replace(super().robot(), power=None)


def broken(now: float) -> float:
    raise SensorError("nothing answers at 0x40")


def test_every_tick_has_the_power_of_a_simulated_servo() -> None:
    rig = Rig()
    resting = rig.run(3)[-1].power
    rig.start("square", frequency=2)
    swimming = [tick.power for tick in rig.run(40)]
    assert resting == pytest.approx(0.06)
    assert min(swimming[1:]) > resting
    assert rig.loop.power.mean == pytest.approx(sum(swimming) / 40)


def test_without_a_power_meter_there_is_no_power_and_no_trouble() -> None:
    rig, _ = fragile_rig(kind=Bare)
    assert rig.run(5)[-1].power is UNSET
    assert (rig.loop.power.mean, rig.loop.power.trouble) == (None, "")


@pytest.mark.parametrize("failing", [broken, lambda now: float("nan"), lambda now: 1 / 0])
def test_a_power_meter_that_fails_is_an_event_only(failing: Callable[[float], float]) -> None:
    rig, robot = fragile_rig(kind=Metered)
    rig.start("square", frequency=2)
    rig.run(5)
    robot.meter = broken
    rig.run(2)
    robot.meter = lambda now: 2.0
    rig.run(1)
    assert "power" not in rig.recorder.kinds()  # two failed reads give no event
    robot.meter = failing
    ticks = rig.run(40)
    assert {tick.power for tick in ticks} == {UNSET}
    assert {tick.mode for tick in ticks} == {"running"}
    assert rig.recorder.kinds().count("power") == 1
    assert rig.recorder.events[-1].level == "warning"
    assert rig.loop.power.trouble.startswith("the power meter cannot be read: ")
    assert rig.loop.power.mean is None

    robot.meter = lambda now: 2.0
    assert rig.run(1)[-1].power == 2.0
    assert rig.recorder.events[-1].message == "the power meter can be read again"
    assert rig.loop.power.trouble == ""
