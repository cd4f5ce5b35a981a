"""Servo on an emulated pigpiod, with the real client, in virtual time."""

import pytest
from msgspec.structs import replace
from rigs.pigpio_rig import FRAME, GPIO, TICK, Bench

from fishd.core.calibration import ServoCalibration
from fishd.core.errors import ServoError


def test_a_write_makes_the_pulse_of_the_angle(bench: Bench) -> None:
    servo = bench.servo()
    servo.write(0.5)
    assert bench.width == 1800
    bench.wait(TICK)
    servo.write(-0.5001)  # 1199.94 µs: rounded, not truncated
    assert bench.width == 1200


def test_nothing_moves_before_the_first_write(bench: Bench) -> None:
    servo = bench.servo()
    servo.release()
    bench.wait(1.0)
    assert bench.width == 0


def test_silence_ends_in_neutral_after_0_2_s_and_in_no_pulses_after_0_5_more(bench: Bench) -> None:
    servo = bench.servo(calibration=ServoCalibration(trim=25))
    for _ in range(10):
        servo.write(0.5)
        bench.wait(TICK)
    last = bench.clock.now - TICK
    assert [width for _, width in bench.daemon.history(GPIO)] == [1825]
    bench.wait(2.0)
    (neutral, width), (off, nothing) = bench.changes_after(last)
    assert (width, nothing) == (1525, 0)
    assert 0.19 <= neutral - last <= 0.24
    assert 0.49 <= off - neutral <= 0.54


def test_the_countdown_knows_the_newest_neutral(bench: Bench) -> None:
    servo = bench.servo()
    servo.write(0.5)
    servo.recalibrate(ServoCalibration(trim=-40.4))
    servo.write(0.5)
    bench.wait(0.3)
    assert bench.width == 1460


@pytest.mark.parametrize(("tick", "countdown", "seconds"), [(0.2, 0.2, 0.6), (TICK, 1.0, 1.0)])
def test_a_slow_loop_has_three_ticks_and_a_longer_countdown_forgives_longer_stalls(
    bench: Bench, tick: float, countdown: float, seconds: float
) -> None:
    servo = bench.servo(replace(bench.settings(), countdown=countdown), tick=tick)
    servo.write(0.5)
    bench.wait(seconds - 0.05)
    assert bench.width == 1800
    bench.wait(0.1)
    assert (bench.width, servo.driver.countdown) == (1500, seconds)


def test_a_write_during_the_hold_at_neutral_keeps_the_pulses(bench: Bench) -> None:
    servo = bench.servo()
    servo.write(0.5)
    bench.wait(0.4)
    assert bench.width == 1500
    for _ in range(20):
        servo.write(0.5)
        bench.wait(TICK)
        assert bench.width == 1800


@pytest.mark.parametrize("while_it_is", [TICK, 0.4], ids=["swimming", "held at neutral"])
def test_a_release_stops_pulses_and_disarms_the_countdown(bench: Bench, while_it_is: float) -> None:
    servo = bench.servo()
    servo.write(0.5)
    bench.wait(while_it_is)
    servo.release()
    servo.release()
    released = bench.clock.now
    bench.wait(2.0)
    assert bench.width == 0
    assert [width for _, width in bench.changes_after(released - FRAME)] == [0]


@pytest.mark.parametrize("pause", [0.05, 1.0])
def test_a_write_after_a_release_brings_pulses_back(bench: Bench, pause: float) -> None:
    servo = bench.servo()
    servo.write(0.5)
    servo.release()
    bench.wait(pause)
    servo.write(-0.5)
    assert bench.width == 1200
    bench.wait(0.3)
    assert bench.width == 1500


def test_close_releases_and_leaves_no_script(bench: Bench) -> None:
    servo = bench.servo()
    servo.write(0.5)
    servo.close()
    servo.close()
    assert bench.width == 0
    assert bench.scripts() == 0
    with pytest.raises(ServoError, match="closed"):
        servo.write(0.0)


def test_close_says_when_pulses_may_still_be_on(bench: Bench) -> None:
    servo = bench.servo()
    servo.write(0.5)
    bench.faults.inject("pigpiod-frozen")
    with pytest.raises(ServoError, match="pigpiod at"):
        servo.close()
    servo.close()
    bench.faults.clear()
