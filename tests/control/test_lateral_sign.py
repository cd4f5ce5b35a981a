"""A reversed F_y is noticed when the tail sets off, on any fish, and a right one never doubted."""

import dataclasses

import pytest
from msgspec.structs import replace
from rigs.harness import Rig, fragile_rig, observe

from fishd.control.estimators.lateral_sign import LateralSign
from fishd.core.signals import Measurement
from fishd.hardware.base import ForceSensor, Robot
from fishd.lab.other_fish import FIRST_SEED, HARSH_FISH, harsh

REST = 3.0


class Interchanged:
    """A force sensor whose wires of F_y are interchanged."""

    def __init__(self, sensor: ForceSensor) -> None:
        self._sensor = sensor

    def read(self, now: float) -> Measurement:
        measured = self._sensor.read(now)
        return replace(measured, fy=-measured.fy)

    def close(self) -> None:
        self._sensor.close()


def reversed_robot(robot: Robot) -> Robot:
    return dataclasses.replace(robot, sensor=Interchanged(robot.sensor))


def started(rig: Rig, controller: str = "swing", **parameters: object) -> bool | None:
    """What is known of the sign once a controller has swum for a second, after a rest."""
    rig.loop.stop()
    rig.run_for(REST)
    rig.start(controller, **parameters)
    rig.run_for(1.0)
    return rig.loop.lateral_sign.reversed


@pytest.mark.parametrize("seed", range(FIRST_SEED, FIRST_SEED + HARSH_FISH))
def test_any_fish_shows_it_when_it_sets_off(seed: int) -> None:
    fish = harsh(seed).overrides
    for controller, parameters in (("swing", {}), ("square", {"frequency": 1.5}), ("sine", {})):
        assert started(Rig(*fish), controller, **parameters) is not True
        assert started(Rig(*fish, wrap=reversed_robot), controller, **parameters) is True


@pytest.mark.parametrize("tick", [0.005, 0.02, 0.1])
def test_at_other_ticks_too(tick: float) -> None:
    assert started(Rig(f"tick={tick}")) is False
    assert started(Rig(f"tick={tick}", wrap=reversed_robot)) is True


def test_it_is_told_once_in_one_line_that_says_what_to_do() -> None:
    rig = Rig(wrap=reversed_robot)
    assert [started(rig) for _ in range(2)] == [True, True]
    (event,) = (event for event in rig.recorder.events if event.kind == "calibration")
    assert (event.level, event.message) == ("warning", rig.loop.lateral_sign.complaint)
    assert event.message.startswith("F_y is reversed: ")
    assert "fishctl calibrate force" in event.message
    assert "fishctl calibrate servo" in event.message


def test_a_right_sign_is_no_event_and_no_complaint() -> None:
    rig = Rig()
    assert started(rig) is False
    assert rig.loop.lateral_sign.complaint == ""
    assert "calibration" not in rig.recorder.kinds()


def test_a_hang_as_the_tail_sets_off_shows_nothing() -> None:
    sign = LateralSign()
    for _ in range(100):
        sign.update(replace(observe(), dt=0.05, instruction_angle=0.0))
    assert not sign.update(replace(observe(), dt=5.0, instruction_angle=0.42))
    assert sign.reversed is None


def test_a_fish_that_did_not_rest_shows_nothing() -> None:
    rig = Rig()
    rig.start("swing")
    rig.run_for(5.0)
    assert rig.loop.lateral_sign.reversed is None


@pytest.mark.parametrize("tick", [-10, 0, 1, 4])
def test_a_push_with_a_force_that_is_not_to_be_believed_shows_nothing(tick: int) -> None:
    rig, robot = fragile_rig()
    rig.run_for(REST)
    rig.run(10 + min(tick, 0))
    if tick >= 0:
        rig.start("swing")
        rig.run(tick)
    robot.fy, robot.suspect = 5.0, "F_y is clipped"
    rig.run(1)
    robot.fy, robot.suspect = None, ""
    rig.start("swing")
    rig.run_for(1.0)
    assert rig.loop.lateral_sign.reversed is None


def test_a_push_that_is_small_or_short_or_drowned_in_noise_shows_nothing() -> None:
    for overrides, parameters in (
        ((), {"amplitude": 0.001, "frequency": 1.0}),
        ((), {"frequency": 10.0}),
        (("simulation.noise=0.5",), {"frequency": 1.0}),
    ):
        assert started(Rig(*overrides), "square", **parameters) is None


def test_a_policy_that_trembles_before_it_swims_shows_it_by_its_first_true_push() -> None:
    rig = Rig(wrap=reversed_robot)
    rig.run_for(REST)
    for angle, ticks in ((-0.03, 4), (0.42, 10)):
        rig.start("hold", angle=angle)
        rig.run(ticks)
    assert rig.loop.lateral_sign.reversed is True


def test_a_new_calibration_is_seen_anew_and_a_tare_asks_for_a_rest() -> None:
    rig = Rig(wrap=reversed_robot)
    assert started(rig) is True
    rig.loop.lateral_sign.forget()
    assert rig.loop.lateral_sign.complaint == ""
    rig.loop.stop()
    rig.run_for(REST)
    rig.loop.lateral_sign.rest()
    rig.start("swing")
    rig.run_for(1.0)
    assert rig.loop.lateral_sign.reversed is None
    assert started(rig) is True
