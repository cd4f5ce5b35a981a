"""Recovery of the pigpio servo: killed predecessors, a lost pigpiod, a last resort."""

import time
from typing import Any

import pigpio
import pytest
from msgspec.structs import replace
from rigs.pigpio_rig import FRAME, GPIO, Bench, connect

from fishd.core.calibration import ServoCalibration
from fishd.core.errors import ServoError
from fishd.hardware.servo.pigpio_pulses import find_countdowns, remove
from fishd.hardware.servo.pulses import NEUTRAL_TIME_S

ALT5 = 2
READ = pigpio._PI_CMD_READ


def test_pulses_of_a_killed_fishd_go_to_neutral_once_the_next_one_connects(bench: Bench) -> None:
    bench.servo().write(0.5)
    bench.wait(0.05)
    with pytest.raises(ServoError, match="soft limits"):
        bench.servo().write(9.0)  # needs no connection
    successor = bench.servo(calibration=ServoCalibration(trim=10))
    connect(successor)
    bench.wait(0.03)
    assert bench.width == 1510
    bench.wait(0.6)
    assert bench.width == 0
    assert bench.scripts() == 1


def test_pulses_that_went_on_in_a_frozen_pigpiod_stop_once_it_is_back(bench: Bench) -> None:
    servo = bench.servo()
    servo.write(0.5)
    bench.faults.inject("pigpiod-frozen")
    for _ in range(2):
        servo.write(0.5)  # late, and waited for
    with pytest.raises(ServoError, match="no answer within"):
        servo.write(0.5)
    bench.wait(1.0)
    assert bench.width == 1800
    bench.faults.clear()
    connect(servo)
    bench.wait(FRAME)
    assert bench.width == 0
    assert servo.driver.counters() == {"servo_reconnects": 1, "servo_late_answers": 3}
    bench.wait(1.0)
    assert bench.width == 0


def test_without_pigpiod_it_asks_at_most_twice_a_second_in_virtual_time(bench: Bench) -> None:
    servo = bench.servo()
    bench.faults.inject("pigpiod-gone")
    with pytest.raises(ServoError, match="not connected: Connection refused"):
        servo.write(0.5)
    bench.faults.clear()
    assert bench.width == 0  # pigpiod sees that it may go on
    bench.wait(0.4)
    with pytest.raises(ServoError, match="not connected: Connection refused"):
        servo.write(0.5)
    bench.wait(0.2)
    servo.write(0.5)
    assert bench.width == 1800
    assert servo.driver.counters() == {"servo_reconnects": 0, "servo_late_answers": 0}


def test_scripts_of_others_and_of_other_pins_stay(bench: Bench) -> None:
    with bench.client() as client:
        script = client.store_script(b"tag 0 mils 10 jmp 0")
        bench.wait(0.01)
        client.run_script(script, [20, GPIO, 1500])
    neighbour = bench.servo(replace(bench.settings(), gpio=13))
    neighbour.write(0.2)
    bench.servo().write(0.5)
    assert bench.scripts() == 3
    neighbour.write(0.3)


def test_the_last_resort_moves_a_swimming_servo_to_neutral_and_releases_it(bench: Bench) -> None:
    bench.servo().write(0.5)
    bench.wait(0.1)
    begun = bench.clock.now
    assert bench.last_resort(1510.0) is True
    assert bench.scripts() == 0
    bench.wait(2.0)
    assert [width for _, width in bench.changes_after(begun - 1e-9)] == [1510, 0]
    assert 0.29 <= bench.changes_after(begun)[-1][0] - begun <= 0.35


def test_the_last_resort_leaves_a_servo_without_pulses_alone(bench: Bench) -> None:
    assert bench.last_resort() is False
    killed = bench.servo()
    killed.write(0.5)
    bench.wait(2.0)  # the countdown has done its work
    before = bench.clock.now
    assert bench.last_resort() is False
    assert bench.clock.now == before
    assert bench.changes_after(before) == []
    assert bench.scripts() == 0


@pytest.mark.parametrize("failure", ["neutral is refused", "the connection breaks"])
def test_the_last_resort_stops_the_pulses_though_a_step_fails(bench: Bench, failure: str) -> None:
    bench.servo().write(0.5)
    bench.wait(0.1)
    if failure == "neutral is refused":
        bench.refuse(pigpio._PI_CMD_SERVO, 1500)
    else:
        bench.hang_up_in_next_sleep()
    assert bench.last_resort() is True
    assert bench.width == 0
    assert bench.scripts() == 0


def test_the_last_resort_succeeds_beside_a_fishd_that_takes_its_script_away(bench: Bench) -> None:
    bench.servo().write(0.5)
    sleep = bench.clock.sleep

    def reconnect(seconds: float) -> None:
        if seconds == NEUTRAL_TIME_S:
            with bench.client() as client:
                remove(client, find_countdowns(client, GPIO))
        sleep(seconds)

    bench.clock.sleep = reconnect  # type: ignore[method-assign]
    assert bench.last_resort() is True
    del bench.clock.sleep
    assert bench.width == 0


def test_the_last_resort_fails_while_another_program_goes_on_with_its_pulses(bench: Bench) -> None:
    bench.servo().write(0.5)
    sleep = bench.clock.sleep

    def insist(seconds: float) -> None:
        sleep(seconds)
        with bench.client() as client:
            client.set_servo_pulsewidth(GPIO, 1600)

    bench.clock.sleep = insist  # type: ignore[method-assign]
    with pytest.raises(ServoError, match=f"GPIO {GPIO} has pulses again: another program"):
        bench.last_resort()
    del bench.clock.sleep
    assert bench.width == 1600


def test_the_last_resort_stops_the_pulses_though_the_user_is_impatient(bench: Bench) -> None:
    bench.servo().write(0.5)

    def interrupt(seconds: float) -> None:
        raise KeyboardInterrupt

    bench.clock.sleep = interrupt  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        bench.last_resort()
    del bench.clock.sleep
    assert bench.width == 0


def test_a_living_fishd_learns_from_an_error_that_the_last_resort_was_taken(bench: Bench) -> None:
    servo = bench.servo()
    servo.write(0.5)
    assert bench.last_resort() is True
    with pytest.raises(ServoError, match="deleted fishd's script, as 'fishctl release' does; re"):
        servo.write(0.5)
    assert bench.width == 0


def leave_pulses_of_the_peripheral(bench: Bench, width: float = 1740.0) -> None:
    """Leave pulses of hardware PWM, as a killed fishd of an old version or another program does."""
    with bench.client() as client:
        client.hardware_PWM(GPIO, 50, round(width * 50))
    bench.wait(0.1)
    assert bench.width == pytest.approx(width, abs=0.1)


def test_a_fishd_that_starts_ends_them_at_neutral(bench: Bench) -> None:
    leave_pulses_of_the_peripheral(bench)
    bench.faults.inject("pigpiod-restart")
    connect(bench.servo())
    bench.wait(0.05)
    assert bench.width == 1500
    bench.wait(1.0)
    assert bench.width == 0


def test_a_pin_that_is_the_peripherals_but_has_no_pulses_is_left_alone(bench: Bench) -> None:
    with bench.client() as client:
        client.set_mode(GPIO, ALT5)  # as the overlay of the kernel's PWM leaves it
    assert bench.last_resort() is False
    assert bench.daemon.history(GPIO) == []
    with bench.client() as client:
        assert client.get_mode(GPIO) == ALT5


def test_each_of_many_looks_at_a_pin_has_its_own_time_limit(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    with bench.client() as client:
        client.set_mode(GPIO, ALT5)
    commands = bench.daemon._commands
    execute = commands.execute

    def slow(when: float, number: int, *rest: Any) -> tuple[int, bytes]:
        if number == READ:
            time.sleep(0.01)  # 1.3 s for all of them
        return execute(when, number, *rest)

    monkeypatch.setattr(commands, "execute", slow)
    assert bench.last_resort() is False


def test_software_pwm_of_another_program_counts_as_pulses_too(bench: Bench) -> None:
    with bench.client() as client:
        client.set_PWM_dutycycle(GPIO, 128)
    bench.wait(0.1)
    assert bench.last_resort() is True
    bench.wait(0.1)
    assert bench.width == 0
