"""A reversed F_y is detected when the tail starts to move, on any fish, and a right one is not.

Then its sign is corrected for controllers, or they are refused, as configured.
"""

import dataclasses
import statistics
from collections.abc import Callable

import pytest
from msgspec import UNSET, UnsetType
from msgspec.structs import replace
from rigs.harness import Rig, Scripted, fragile_rig, observe
from rigs.reversed_force import ReversedSensor, reversed_robot

from fishd.control.estimators.lateral_sign import LateralSign
from fishd.core.errors import Refused
from fishd.core.signals import Measurement, Observation, Tick
from fishd.hardware.base import Robot
from fishd.lab.compare.survey import FIRST_SEED, HARSH_FISH_COUNT, harsh

REST_S = 3.0
Wrap = Callable[[Robot], Robot]


def thrust(ticks: list[Tick], rig: Rig) -> float:
    """Return the mean true thrust [N]."""
    squares = [tick.alpha_rate**2 for tick in ticks if not isinstance(tick.alpha_rate, UnsetType)]
    return rig.config.plant.thrust_coefficient * statistics.mean(squares)


def mean_thrust(
    controller: str, parameters: dict[str, object], *overrides: str, wrap: Wrap
) -> float:
    """Return the mean thrust from 5 to 20 s after a start from rest [N]."""
    rig = Rig(*overrides, wrap=wrap)
    rig.run_for(REST_S)
    rig.start(controller, **parameters)
    rig.run_for(5.0)
    return thrust(rig.run_for(15.0), rig)


def detect_reversal(rig: Rig, controller: str = "swing", **parameters: object) -> bool | None:
    """Return whether F_y is reversed, as detected in a second of swimming after a rest."""
    rig.loop.stop()
    rig.run_for(REST_S)
    rig.start(controller, **parameters)
    rig.run_for(1.0)
    return rig.loop.perception.lateral_sign.reversed


@pytest.mark.parametrize("seed", range(FIRST_SEED, FIRST_SEED + HARSH_FISH_COUNT))
def test_a_reversed_force_is_detected_on_any_fish_when_it_sets_off(seed: int) -> None:
    fish = harsh(seed).overrides
    for controller, parameters in (("swing", {}), ("square", {"frequency": 1.5}), ("sine", {})):
        assert detect_reversal(Rig(*fish), controller, **parameters) is not True
        assert detect_reversal(Rig(*fish, wrap=reversed_robot), controller, **parameters) is True


@pytest.mark.parametrize("tick", [0.005, 0.02, 0.1])
def test_a_reversed_force_is_detected_at_other_ticks_too(tick: float) -> None:
    right = Rig(f"tick={tick}")
    assert detect_reversal(right) is False
    assert right.loop.perception.lateral_sign.complaint is None
    assert "calibration" not in right.recorder.kinds()
    assert detect_reversal(Rig(f"tick={tick}", wrap=reversed_robot)) is True


def test_a_reversed_force_is_reported_once_in_one_line_with_its_remedy() -> None:
    rig = Rig(wrap=reversed_robot)
    assert [detect_reversal(rig) for _ in range(2)] == [True, True]
    (event,) = (event for event in rig.recorder.events if event.kind == "calibration")
    assert (event.level, event.message) == ("warning", rig.loop.perception.lateral_sign.complaint)
    assert event.message.startswith("F_y is reversed: ")
    assert "fishctl calibrate force" in event.message
    assert "fishctl calibrate servo" in event.message


def test_a_hang_as_the_tail_sets_off_decides_nothing() -> None:
    sign = LateralSign()
    for _ in range(100):
        sign.update(replace(observe(), dt=0.05, instruction_angle=0.0), 0.0)
    assert not sign.update(replace(observe(), dt=5.0, instruction_angle=0.42), 0.0)
    assert sign.reversed is None


@pytest.mark.parametrize("tick", [-10, 0, 1, 4])
def test_a_push_with_a_suspect_force_decides_nothing(tick: int) -> None:
    rig, robot = fragile_rig()
    rig.run_for(REST_S)
    rig.run(10 + min(tick, 0))
    if tick >= 0:
        rig.start("swing")
        rig.run(tick)
    robot.fy, robot.suspect = 5.0, "F_y is clipped"
    rig.run(1)
    robot.fy, robot.suspect = None, None
    rig.start("swing")
    rig.run_for(1.0)
    assert rig.loop.perception.lateral_sign.reversed is None


def test_a_push_without_a_rest_or_small_or_short_or_hidden_by_noise_decides_nothing() -> None:
    restless = Rig().start("swing")
    restless.run_for(5.0)
    assert restless.loop.perception.lateral_sign.reversed is None
    for overrides, parameters in (
        ((), {"amplitude": 0.001, "frequency": 1.0}),
        ((), {"frequency": 10.0}),
        (("simulation.noise=0.5",), {"frequency": 1.0}),
    ):
        assert detect_reversal(Rig(*overrides), "square", **parameters) is None


def test_a_policy_with_small_movements_at_first_is_judged_by_its_first_large_push() -> None:
    rig = Rig(wrap=reversed_robot)
    rig.run_for(REST_S)
    for angle, ticks in ((-0.03, 4), (0.42, 10)):
        rig.start("hold", angle=angle)
        rig.run(ticks)
    assert rig.loop.perception.lateral_sign.reversed is True


def test_a_new_calibration_resets_the_sign_and_a_tare_requires_a_rest() -> None:
    rig = Rig(wrap=reversed_robot)
    assert detect_reversal(rig) is True
    assert rig.loop.perception.estimator.fy_corrected
    rig.loop.perception.forget_force(scale=True)
    assert rig.run()[0].fy_corrected is UNSET
    assert rig.loop.perception.lateral_sign.complaint is None
    rig.loop.stop()
    rig.run_for(REST_S)
    rig.loop.perception.lateral_sign.rest()
    rig.start("swing")
    rig.run_for(1.0)
    assert rig.loop.perception.lateral_sign.reversed is None
    assert detect_reversal(rig) is True


@pytest.mark.parametrize(
    ("controller", "parameters", "overrides"),
    [
        ("swing", {"C": 0.95, "lead": 0.1}, ("plant.servo_delay=0.05",)),
        ("swing", {"C": "auto"}, ()),
        ("swing", {}, ("estimator.kind=observer",)),
        ("swing", {}, ("estimator.leak=auto", "plant.lateral_drag=0.12")),
        ("swing", {}, harsh(FIRST_SEED).overrides),
        ("thrust", {"target": 0.015}, ()),
        ("ppo", {"policy": "default-fish"}, harsh(FIRST_SEED).overrides),
    ],
)
def test_after_the_first_push_a_fish_with_a_reversed_force_swims_as_well_as_with_a_right_one(
    controller: str, parameters: dict[str, object], overrides: tuple[str, ...]
) -> None:
    right = mean_thrust(controller, parameters, *overrides, wrap=lambda robot: robot)
    corrected = mean_thrust(controller, parameters, *overrides, wrap=reversed_robot)
    assert corrected == pytest.approx(right, rel=0.02)


def test_controllers_see_the_other_sign_and_telemetry_the_force_as_measured() -> None:
    rig = Rig("simulation.noise=0", wrap=reversed_robot)
    seen: list[Observation] = []
    square = [0.42] * 6 + [-0.42] * 6

    def act(observation: Observation) -> float:
        seen.append(observation)
        return square[len(seen) % 12]

    rig.run_for(REST_S)
    rig.start(Scripted(act))
    before, *ticks = rig.run_for(2.0)[-25:]
    for last, tick, observation in zip([before, *ticks], ticks, seen[-24:], strict=False):
        assert tick.fy_corrected is True
        assert (observation.fy, observation.fy_rate) == (-tick.fy, -tick.fy_rate)
        assert tick.fy_rate == pytest.approx((tick.fy - last.fy) / 0.05)
        assert observation.fin_velocity == tick.fin_velocity
    assert (
        statistics.correlation(
            [tick.fin_velocity for tick in ticks], [float(str(tick.alpha_rate)) for tick in ticks]
        )
        > 0.9
    )


def test_with_refuse_the_first_push_is_a_fault_and_the_next_start_is_refused() -> None:
    rig = Rig("estimator.reversed_fy=refuse", wrap=reversed_robot)
    detect_reversal(rig)
    assert (rig.mode, rig.reason) == ("fault", "fy-reversed")
    rig.run_for(REST_S)
    rig.loop.clear_fault()
    for controller, parameters in (("swing", {}), ("ppo", {"policy": "default-fish"})):
        with pytest.raises(Refused, match="F_y is reversed") as refused:
            rig.start(controller, **parameters)
        assert refused.value.code == "fy-reversed"
    # This controller ignores the force
    assert detect_reversal(rig, "square", frequency=1.5) is True
    assert rig.mode == "running"
    rig.loop.perception.forget_force(scale=True)
    rig.start("swing")


def test_with_warn_nothing_is_corrected() -> None:
    rig = Rig("estimator.reversed_fy=warn", wrap=reversed_robot)
    assert detect_reversal(rig) is True
    assert not rig.loop.perception.estimator.fy_corrected
    assert "so swing and policies fail" in rig.loop.perception.lateral_sign.complaint


class Touched(ReversedSensor):
    """A force sensor that is touched at times, so that F_y seems to be reversed."""

    touched = False

    def read(self, now: float) -> Measurement:
        measurement = self._sensor.read(now)
        return replace(measurement, fy=-measurement.fy) if self.touched else measurement


@pytest.mark.parametrize(
    ("touches", "corrected"),
    [((1, 0), (True, False)), ((0, 1, 0), (False,) * 3), ((0, 0, 1, 1, 0), (False,) * 5)],
)
def test_a_disturbance_changes_no_known_sign_and_its_wrong_first_sign_does_not_last(
    touches: tuple[int, ...], corrected: tuple[bool, ...]
) -> None:
    sensors: list[Touched] = []

    def touchable(robot: Robot) -> Robot:
        sensors.append(Touched(robot.sensor))
        return dataclasses.replace(robot, sensor=sensors[0])

    rig = Rig(wrap=touchable)
    corrections = []
    for touch in touches:
        rig.loop.stop()
        rig.run_for(REST_S)
        sensors[0].touched = bool(touch)
        rig.start("square", frequency=1.0)
        rig.run_for(0.5)
        sensors[0].touched = False
        rig.run_for(0.5)
        corrections.append(rig.loop.perception.estimator.fy_corrected)
    assert tuple(corrections) == corrected
