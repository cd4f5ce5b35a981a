"""Late answers of pigpiod: the servo waits for them, but not longer than the countdown."""

import contextlib
import time
from typing import Any

import pytest
from msgspec.structs import replace
from rigs.pigpio_rig import FRAME, GPIO, TICK, Bench

from fishd.core.clock import SystemClock
from fishd.core.errors import ServoError
from fishd.hardware.servo.calibrated_servo import CalibratedServo


def late_tick(bench: Bench, servo: CalibratedServo, angle: float) -> None:
    """Run a tick whose answer is late, but arrives before the next tick."""
    bench.faults.inject("pigpiod-frozen")
    try:
        servo.write(angle)
    finally:
        bench.faults.clear()
    bench.wait(TICK)


def thaw(bench: Bench) -> None:
    """Let pigpiod continue, and wait until it has executed all commands."""
    bench.faults.clear()
    with bench.client() as client:
        client.get_pigpio_version()


def test_a_late_answer_now_and_then_does_not_end_the_link(bench: Bench) -> None:
    servo = bench.servo()
    for _ in range(4):
        servo.write(0.5)
        bench.wait(TICK)
        late_tick(bench, servo, -0.5)
        late_tick(bench, servo, -0.5)
    servo.write(0.5)
    assert bench.width == 1800
    assert servo.driver.counters() == {"servo_reconnects": 0, "servo_late_answers": 8}
    assert {width for _, width in bench.daemon.history(GPIO)} == {1800}


def stall(bench: Bench) -> None:
    """Let the next command take 0.3 s of real time, as on a busy machine."""
    commands = bench.daemon._commands
    execute = commands.execute

    def stalling(*command: Any) -> tuple[int, bytes]:
        commands.execute = execute  # type: ignore[method-assign]
        time.sleep(0.3)
        return execute(*command)

    commands.execute = stalling  # type: ignore[method-assign]


def test_in_virtual_time_no_answer_is_late_because_the_machine_is_busy(bench: Bench) -> None:
    servo = bench.servo()
    stall(bench)
    servo.write(0.5)  # which connects
    for _ in range(2):
        stall(bench)
        servo.write(-0.5)
    assert servo.driver.counters() == {"servo_reconnects": 0, "servo_late_answers": 0}


def test_the_last_resort_has_time_for_each_of_its_many_commands(bench: Bench) -> None:
    bench.servo().write(0.5)
    commands = bench.daemon._commands
    execute = commands.execute

    def slow(*command: Any) -> tuple[int, bytes]:
        time.sleep(0.035)  # of real time: more than 1 s for all scripts
        return execute(*command)

    commands.execute = slow  # type: ignore[method-assign]
    assert bench.last_resort() is True
    assert bench.width == 0


def test_the_third_late_answer_in_a_row_ends_it(bench: Bench) -> None:
    servo = bench.servo()
    servo.write(0.5)
    late_tick(bench, servo, 0.5)
    late_tick(bench, servo, 0.5)
    with pytest.raises(ServoError, match=r"no answer within 8 ms; reconnecting$"):
        late_tick(bench, servo, 0.5)


def test_where_the_next_tick_would_come_after_the_countdown_the_first_ends_it(bench: Bench) -> None:
    servo = bench.servo(tick=0.2)  # and so a countdown of 0.6 s
    servo.write(0.5)
    bench.wait(0.45)
    with pytest.raises(ServoError, match="no answer within"):
        late_tick(bench, servo, 0.5)


def test_after_a_release_a_late_answer_is_no_error_however_long_the_release(bench: Bench) -> None:
    servo = bench.servo()
    servo.write(0.5)
    servo.release()
    bench.wait(2.0)
    late_tick(bench, servo, -0.5)
    servo.write(0.5)
    assert bench.width == 1800
    assert servo.driver.counters() == {"servo_reconnects": 0, "servo_late_answers": 1}


def test_an_answer_that_came_after_the_countdown_is_not_trusted(bench: Bench) -> None:
    servo = bench.servo()
    servo.write(0.5)
    bench.wait(TICK)
    bench.faults.inject("pigpiod-frozen")
    servo.write(0.5)
    bench.wait(1.0)  # fishd itself was held up
    bench.faults.clear()
    with pytest.raises(ServoError, match="its countdown may have released the servo; reconn"):
        servo.write(0.5)


def test_pulses_end_as_ever_when_fishd_dies_while_an_answer_is_owed(bench: Bench) -> None:
    servo = bench.servo()
    servo.write(0.5)
    bench.faults.inject("pigpiod-frozen")
    servo.write(-0.5)
    thaw(bench)
    bench.wait(0.3)
    assert bench.width == 1500
    bench.wait(0.6)
    assert bench.width == 0


def test_a_release_is_sent_though_an_answer_is_owed_and_says_that_it_waits(bench: Bench) -> None:
    servo = bench.servo()
    servo.write(0.5)
    bench.faults.inject("pigpiod-frozen")
    servo.write(0.5)
    with pytest.raises(ServoError, match="no answer within 8 ms; waiting for it"):
        servo.release()
    thaw(bench)
    bench.wait(FRAME)
    assert bench.width == 0  # at once, without another connection
    servo.release()
    assert servo.driver.counters()["servo_reconnects"] == 0


@pytest.mark.realtime
def test_no_write_waits_longer_than_its_limit_also_for_an_answer_that_is_owed() -> None:
    with contextlib.ExitStack() as stack:
        bench = Bench(stack, SystemClock())
        servo = bench.servo(replace(bench.settings(), timeout=0.1, countdown=2.0))
        servo.write(0.5)
        bench.faults.inject("pigpiod-frozen")
        durations = []
        for _ in range(3):
            begun = time.monotonic()
            with contextlib.suppress(ServoError):
                servo.write(0.5)
            durations.append(time.monotonic() - begun)
        assert max(durations) < 0.19  # not twice the limit
