"""What the loop says of a servo that cannot be reached, and of a force that is not there."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.harness import fragile_rig
from rigs.lockstep_rig import LockstepRig, lockstep_rig

from fishd.core.console import status_line
from fishd.core.errors import SensorError, ServoError
from fishd.core.signals import Percentiles, Status, Timing


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[LockstepRig]:
    with lockstep_rig(tmp_path) as rig:
        rig.start("square")
        rig.run_for(1.0)
        assert (rig.loop.servo.on, rig.loop.servo.lost) == (True, False)
        yield rig


@pytest.mark.parametrize("fault", ["pigpiod-gone", "pigpiod-frozen"])
def test_a_servo_behind_a_dead_pigpiod_is_lost_and_may_have_pulses_until_it_is_released(
    rig: LockstepRig, fault: str
) -> None:
    rig.pi.faults.inject(fault)
    rig.run_for(1.0)
    assert (rig.loop.servo.on, rig.loop.servo.lost) == (True, True)
    rig.pi.faults.clear()
    rig.run_for(3.0)
    assert (rig.loop.servo.on, rig.loop.servo.lost) == (False, False)
    assert rig.pulse == 0.0


def test_a_servo_that_was_released_before_it_was_lost_has_no_pulses() -> None:
    rig, robot = fragile_rig()
    rig.run(2)
    rig.loop.estop("test")
    robot.release_error = ServoError("pigpiod is gone")
    rig.run(2)
    assert (rig.loop.servo.on, rig.loop.servo.lost) == (False, True)


def test_a_force_is_lost_with_the_third_read_that_fails_and_back_with_the_next_good_one() -> None:
    rig, robot = fragile_rig()
    rig.run(3)
    robot.read_error = SensorError("unplugged")
    lost = []
    for _ in range(4):
        rig.run()
        lost.append(rig.loop.supervisor.sensor_lost)
    assert lost == [False, False, True, True]
    robot.read_error = None
    rig.run()
    assert rig.mode == "fault"
    assert not rig.loop.supervisor.sensor_lost


def test_a_force_that_is_not_to_be_believed_is_lost_too() -> None:
    rig, robot = fragile_rig()
    robot.suspect = "F_x is clipped"
    rig.run(3)
    assert rig.loop.supervisor.sensor_lost
    robot.suspect = ""
    rig.run(1)
    assert not rig.loop.supervisor.sensor_lost


def line(**given: object) -> str:
    none = Percentiles(0.0, 0.0, 0.0, 0)
    fields = dict.fromkeys(Status.__struct_fields__, 0)
    what = {
        "mode": "fault",
        "reason": None,
        "controller": "hold",
        "thrust": 0.0217,
        "force_unit": "N",
    }
    return status_line(Status(**fields | what | {"timing": Timing(none, none, {})} | given))


def test_the_status_line_shows_no_thrust_without_a_force_and_says_that_the_servo_is_lost() -> None:
    assert "thrust  21.70 mN" in line()
    assert "servo" not in line()
    assert "thrust      – mN" in line(sensor_lost=True)
    assert line(servo_lost=True).endswith("servo not reached")


def test_the_status_line_shows_volts_where_the_sensor_is_not_calibrated() -> None:
    assert "thrust  21.70 mV" in line(force_unit="V")
