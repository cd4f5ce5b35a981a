"""Pulses of the PWM peripheral, which outlive pigpiod: the last resort and a fishd end them."""

import contextlib
from collections.abc import Iterator

import pigpio
import pytest
from rigs.pigpio_rig import GPIO, PigpioBench, connect

HARDWARE_PWM = 86
SET_MODE = 0
ALT5 = 2


@pytest.fixture
def bench() -> Iterator[PigpioBench]:
    with contextlib.ExitStack() as stack:
        yield PigpioBench(stack)


def leave_pulses(bench: PigpioBench, width: float = 1740.0) -> None:
    """As a fishd of old with hardware PWM, or another program, when it was killed."""
    with bench.client() as client:
        client.hardware_PWM(GPIO, 50, round(width * 50))
    bench.wait(0.1)
    assert bench.width == pytest.approx(width, abs=0.1)


def test_they_go_on_when_pigpiod_is_started_again_which_knows_nothing_of_them(
    bench: PigpioBench,
) -> None:
    leave_pulses(bench)
    bench.faults.inject("pigpiod-restart")
    bench.wait(1.0)
    assert bench.width == pytest.approx(1740, abs=0.1)
    with bench.client() as client, pytest.raises(pigpio.error, match="not in use for PWM"):
        client.get_PWM_dutycycle(GPIO)
    with bench.client() as client:
        client.hardware_PWM(GPIO, 0, 0)  # of no use, as on a Pi
    bench.wait(0.1)
    assert bench.width == pytest.approx(1740, abs=0.1)


@pytest.mark.parametrize("restarted", [False, True])
def test_the_last_resort_ends_them_at_neutral_and_says_so(
    bench: PigpioBench, restarted: bool
) -> None:
    leave_pulses(bench)
    if restarted:
        bench.faults.inject("pigpiod-restart")
    begun = bench.clock.now
    assert bench.last_resort() is True
    bench.wait(1.0)
    assert bench.width == 0
    assert 1500 in [width for _, width in bench.changes_after(begun)]
    assert bench.last_resort() is False


@pytest.mark.parametrize("restarted", [False, True])
def test_a_fishd_that_starts_ends_them_at_neutral(bench: PigpioBench, restarted: bool) -> None:
    leave_pulses(bench)
    if restarted:
        bench.faults.inject("pigpiod-restart")
    connect(bench.servo())
    bench.wait(0.05)
    assert bench.width == 1500
    bench.wait(1.0)
    assert bench.width == 0


def test_a_pin_that_is_the_peripherals_but_has_no_pulses_is_left_alone(bench: PigpioBench) -> None:
    with bench.client() as client:
        client.set_mode(GPIO, ALT5)  # as the overlay of the kernel's PWM leaves it
    assert bench.last_resort() is False
    assert bench.daemon.history(GPIO) == []
    with bench.client() as client:
        assert client.get_mode(GPIO) == ALT5


def test_software_pwm_of_another_program_counts_as_pulses_too(bench: PigpioBench) -> None:
    with bench.client() as client:
        client.set_PWM_dutycycle(GPIO, 128)
    bench.wait(0.1)
    assert bench.last_resort() is True
    bench.wait(0.1)
    assert bench.width == 0
