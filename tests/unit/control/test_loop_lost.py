"""A fishd that stood still, a servo that cannot be reached, and a force that cannot be read."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.harness import Rig, Scripted, Wrapped, fragile_rig
from rigs.lockstep_rig import NEUTRAL, LockstepRig, lockstep_rig

from fishd.core.console import status_line
from fishd.core.errors import SensorError, ServoError
from fishd.core.signals import Observation, Percentiles, Status, Timing
from fishd.hardware.base import Robot


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[LockstepRig]:
    # The sensor is not tested here
    with lockstep_rig(tmp_path, "force_sensor.data_rate=250") as rig:
        rig.start("hold", angle=0.3)
        rig.run_for(1.0)
        assert rig.pulse > NEUTRAL + 100
        yield rig


def stand_still(rig: LockstepRig, seconds: float) -> None:
    """Skip ticks, as if the process was stopped or the machine suspended."""
    rig.index += round(seconds / rig.config.tick)


@pytest.mark.parametrize("seconds", [0.25, 0.5, 2.0])
def test_after_a_hang_the_servo_is_released_until_a_clear(rig: LockstepRig, seconds: float) -> None:
    since = rig.now
    stand_still(rig, seconds)
    rig.run_for(1.0)
    assert (rig.mode, rig.reason) == ("fault", "overrun")
    assert rig.loop.supervisor.reason.message == (
        f"fishd stood still for {1e3 * seconds + 50:.0f} ms, and the servo has gone to neutral by "
        "itself, its pulses end within half a second: the machine is overloaded or was suspended"
    )
    assert rig.recorder.kinds().count("fault") == 1
    widths = [width for _, width in rig.pulses_since(since)]
    assert widths == [pytest.approx(NEUTRAL, abs=5), 0.0]  # and no pulse after it
    assert not rig.loop.servo.on
    rig.loop.clear_fault()
    rig.run_for(0.2)
    assert rig.mode == "idle"
    assert rig.pulse == pytest.approx(NEUTRAL, abs=5)


def test_after_a_hang_at_rest_pulses_do_not_start_again(rig: LockstepRig) -> None:
    rig.loop.stop()
    rig.run_for(1.0)
    stand_still(rig, 1.0)
    since = rig.now
    rig.run_for(1.0)
    assert (rig.mode, rig.reason) == ("fault", "overrun")
    assert [width for _, width in rig.pulses_since(since) if width] == []


def test_a_hang_while_fading_in_fault_ends_in_a_release(rig: LockstepRig) -> None:
    rig.start(Scripted(lambda _: float("nan")))
    rig.run_for(0.1)
    since = rig.now
    stand_still(rig, 0.5)
    rig.run_for(0.5)
    assert rig.reason == "controller-error"
    widths = [width for _, width in rig.pulses_since(since)]
    assert widths[-2:] == [pytest.approx(NEUTRAL, abs=5), 0.0]
    assert not rig.loop.servo.on


def test_a_shorter_hang_is_survived(rig: LockstepRig) -> None:
    since = rig.now
    stand_still(rig, 0.1)
    rig.run_for(1.0)
    assert rig.mode == "running"
    assert rig.pulses_since(since) == []


def rig_with_countdown(seconds: float) -> tuple[Rig, Wrapped]:
    robots: list[Wrapped] = []

    def wrap(robot: Robot) -> Robot:
        robots.append(Wrapped(robot))
        return dataclasses.replace(robots[0].robot(), countdown=seconds)

    return Rig(wrap=wrap), robots[0]


def test_a_hang_within_a_tick_is_noticed_before_its_angle_is_sent() -> None:
    rig, robot = rig_with_countdown(0.2)
    delays = iter([0.0, 0.0, 0.3])

    def hang(_: Observation) -> float:
        rig.clock.now += next(delays, 0.0)
        return 0.4

    rig.start(Scripted(hang))
    rig.run(2)
    robot.log.clear()
    tick = rig.run(1)[-1]
    assert (tick.mode, tick.phi_c, tick.servo_on) == ("fault", 0.0, False)
    assert robot.log == [None]


def test_a_hang_during_a_write_that_fails_is_reported_as_a_hang() -> None:
    rig, robot = rig_with_countdown(0.2)
    rig.start("square")
    rig.run(2)

    def hang(angle: float) -> None:
        rig.clock.now += 0.3
        raise ServoError("pigpiod has answered too late")

    robot.write = hang  # type: ignore[method-assign]
    assert rig.run(1)[-1].mode == "fault"
    assert rig.loop.supervisor.reason.code == "overrun"


def test_a_servo_without_a_countdown_continues_after_a_hang() -> None:
    rig = Rig().start("square")
    rig.run(10)
    assert rig.run(1, missed=40)[-1].mode == "running"


@pytest.mark.parametrize("fault", ["pigpiod-gone", "pigpiod-frozen"])
def test_a_servo_behind_a_dead_pigpiod_may_have_pulses_yet(rig: LockstepRig, fault: str) -> None:
    rig.pi.faults.inject(fault)
    rig.run_for(1.0)
    assert (rig.loop.servo.on, rig.loop.servo.lost) == (True, True)
    rig.pi.faults.clear()
    rig.run_for(3.0)
    assert (rig.loop.servo.on, rig.loop.servo.lost) == (False, False)
    assert rig.pulse == 0.0


@pytest.mark.parametrize("fault", ["read_error", "suspect"])
def test_a_force_is_lost_with_the_third_bad_read_and_back_with_a_good_one(fault: str) -> None:
    rig, robot = fragile_rig()
    rig.run(3)
    good = getattr(robot, fault)
    setattr(robot, fault, SensorError("unplugged") if fault == "read_error" else "F_x is clipped")
    lost = []
    for _ in range(4):
        rig.run()
        lost.append(rig.loop.supervisor.sensor_lost)
    assert lost == [False, False, True, True]
    setattr(robot, fault, good)
    rig.run()
    assert rig.mode == "fault"
    assert not rig.loop.supervisor.sensor_lost


def line(**changes: object) -> str:
    none = Percentiles(0.0, 0.0, 0.0, 0)
    fields = {**dict.fromkeys(Status.__struct_fields__, 0), "timing": Timing(none, none, {})}
    known = {"mode": "fault", "reason": None, "controller": "hold", "thrust": 0.0217}
    return status_line(
        Status(**fields | known | {"force_unit": "N", "speed": None, "readings": {}} | changes)
    )


def test_the_status_line_shows_no_thrust_without_a_force_and_says_that_the_servo_is_lost() -> None:
    assert "21.70 mN (exact)" in line()
    assert "21.70 mV (exact)" in line(force_unit="V")
    assert "servo" not in line()
    assert "thrust             – mN" in line(sensor_lost=True)
    assert line(servo_lost=True).endswith("servo not reached")
