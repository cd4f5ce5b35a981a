"""The best square wave, and swinging control with the true fin velocity, by reference numbers."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from fishd.virtual.plant.optimum import (
    best_square_wave,
    fast_servo_thrust,
    square_wave,
    swims_forwards,
)
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.tethered import TetheredFish

DEFAULT = PlantParameters()

Reference = Callable[[str], list[dict[str, str]]]


def sine(phase: float) -> float:
    return math.sin(2.0 * math.pi * phase)


def triangle(phase: float) -> float:
    return 2.0 / math.pi * math.asin(sine(phase))


def driven(
    wave: Callable[[float], float], amplitude: float, frequency: float
) -> tuple[float, float]:
    """Drive the fish until its thrust repeats; return the thrust (N) and largest fin angle."""
    fish = TetheredFish(DEFAULT)
    steps = max(400, round(200 / frequency))
    commands = [amplitude * wave((i + 0.5) / steps) for i in range(steps)]
    before, thrust = math.inf, 0.0
    while abs(thrust - before) > 1e-6 * thrust:
        windows = [fish.advance(command, 1.0 / (steps * frequency), 1) for command in commands]
        before, thrust = thrust, sum(window.thrust for window in windows) / steps
    return thrust, max(window.fin_peak for window in windows)


def test_square_waves_make_the_reference_thrust_at_every_frequency(reference: Reference) -> None:
    for row in reference("thrust_vs_frequency"):
        if row["waveform"] == "square":
            steady = square_wave(DEFAULT, float(row["Phi_rad"]), float(row["frequency_Hz"]))
            assert 1e3 * steady.thrust == pytest.approx(float(row["mean_thrust_mN"]), rel=1e-4), row
            assert steady.fin_amplitude == pytest.approx(float(row["alpha_max_rad"]), rel=1e-4), row


@pytest.mark.slow
@pytest.mark.parametrize("wave", [sine, triangle])
def test_smooth_waves_make_the_reference_thrust(
    reference: Reference, wave: Callable[[float], float]
) -> None:
    rows = [r for r in reference("thrust_vs_frequency") if r["waveform"] == wave.__name__]
    assert len(rows) == 20
    for row in rows:
        thrust, peak = driven(wave, float(row["Phi_rad"]), float(row["frequency_Hz"]))
        assert 1e3 * thrust == pytest.approx(float(row["mean_thrust_mN"]), rel=1e-4), row
        assert peak == pytest.approx(float(row["alpha_max_rad"]), rel=1e-4), row


def test_the_best_square_wave_is_the_reference_one_at_every_amplitude(reference: Reference) -> None:
    for row in reference("optimum_vs_amplitude"):
        best = best_square_wave(DEFAULT, float(row["Phi_rad"]))
        assert best.frequency == pytest.approx(float(row["best_frequency_Hz"]), abs=0.005), row
        assert 1e3 * best.thrust == pytest.approx(float(row["mean_thrust_mN"]), rel=1e-4), row
        assert best.fin_amplitude == pytest.approx(float(row["alpha_max_rad"]), rel=1e-4), row


@pytest.mark.slow
@pytest.mark.parametrize("xi", [0.01, 20.0])
@pytest.mark.parametrize("amplitude", [0.05, 3.0])
@pytest.mark.parametrize("slack", [0.0, 0.04])
def test_no_frequency_beats_the_best_square_wave(xi: float, amplitude: float, slack: float) -> None:
    p = PlantParameters(xi=xi, cable_slack=slack)
    best = best_square_wave(p, amplitude)
    for frequency in (1.99, *np.geomspace(0.1, 6.0, 15).tolist()):
        assert square_wave(p, amplitude, frequency).thrust <= best.thrust


@pytest.mark.parametrize(
    ("p", "swims"),
    [
        (DEFAULT, True),
        (PlantParameters(servo_law="linear", xi=0.1), True),
        (PlantParameters(backlash=0.9), False),
        (PlantParameters(servo_law="linear", servo_dead_zone=0.5), False),
    ],
)
def test_a_fish_swims_forwards_if_its_best_square_wave_thrusts(
    p: PlantParameters, swims: bool
) -> None:
    assert swims_forwards(p, 0.42) is swims
    assert (best_square_wave(p, 0.42).thrust > 0.0) is swims


@pytest.mark.parametrize(
    "p",
    [
        DEFAULT,
        PlantParameters(backlash=0.1, cable_slack=0.1, servo_dead_zone=0.05),
        PlantParameters(backlash=0.9),
        PlantParameters(quadratic_drag=3.0, servo_delay=0.03, backlash=0.05),
        PlantParameters(xi=0.0, quadratic_drag=0.5),
    ],
)
def test_a_square_wave_from_rest_ends_up_in_the_periodic_state(p: PlantParameters) -> None:
    fish = TetheredFish(p)
    windows = [fish.advance(0.42 * (-1) ** k, 0.3, 1) for k in range(60)]
    steady = square_wave(p, 0.42, 1.0 / 0.6)
    digits = 1e-9 if p == DEFAULT else 1e-6
    assert windows[-1].thrust == pytest.approx(steady.thrust, rel=digits, abs=1e-12)
    if p == DEFAULT:
        assert windows[-1].fin_peak == pytest.approx(steady.fin_amplitude, rel=1e-9)


@pytest.mark.slow
def test_no_frequency_beats_the_best_square_wave_with_quadratic_drag() -> None:
    p = PlantParameters(quadratic_drag=2.0, backlash=0.05)
    best = best_square_wave(p, 0.42)
    for frequency in np.geomspace(0.4, 4.0, 6).tolist():
        assert square_wave(p, 0.42, frequency).thrust <= best.thrust
    assert best.thrust < 0.9 * best_square_wave(PlantParameters(backlash=0.05), 0.42).thrust


@pytest.mark.parametrize("xi", [0.0, 0.3, 1.2, 2.0, 8.0])
def test_a_servo_that_follows_at_once_makes_the_closed_form_thrust(xi: float) -> None:
    p = PlantParameters(xi=xi, servo_speed=1e4, servo_lag=1e-4)
    for frequency in (0.05, 0.5, 1.9, 3.0, 6.0):
        expected = fast_servo_thrust(p, 0.05, frequency)
        assert square_wave(p, 0.05, frequency).thrust == pytest.approx(expected, rel=1e-6)


STEP = 0.004  # s


def half_swing(fish: TetheredFish, command: float, threshold: float) -> tuple[float, float]:
    """Hold the command until the fin slows to `threshold` × its highest speed that way.

    Returns the duration (s) and the impulse of the thrust (N s) until that instant.
    """
    sign = 1.0 if command > 0.0 else -1.0
    highest = duration = impulse = 0.0
    while True:
        before = fish.state
        window = fish.advance(command, STEP, 1)
        speed = sign * fish.state.alpha_rate
        highest = max(highest, speed)
        if highest > 0.0 and speed <= threshold * highest:
            break
        duration += STEP
        impulse += STEP * window.thrust
    early, late = 0.0, STEP
    for _ in range(12):
        middle = 0.5 * (early + late)
        fish.state = before
        window = fish.advance(command, middle, 1)
        if sign * fish.state.alpha_rate <= threshold * highest:
            late = middle
        else:
            early = middle
    return duration + middle, impulse + middle * window.thrust


def swing_thrust(p: PlantParameters, amplitude: float, threshold: float) -> float:
    """Return the mean thrust (N) of swinging control with the true fin velocity."""
    fish = TetheredFish(p)
    swings = [half_swing(fish, amplitude if k % 2 else -amplitude, threshold) for k in range(26)]
    settled = swings[-6:]
    return sum(impulse for _, impulse in settled) / sum(duration for duration, _ in settled)


@pytest.mark.slow
def test_swinging_control_has_the_reference_efficiency_at_every_threshold(
    reference: Callable[[str], list[dict[str, str]]],
) -> None:
    p = PlantParameters()
    best = {}
    for row in reference("swing_efficiency"):
        amplitude, threshold = float(row["Phi_rad"]), float(row["C"])
        if amplitude not in best:
            best[amplitude] = best_square_wave(p, amplitude).thrust
        relative_thrust = swing_thrust(p, amplitude, threshold) / best[amplitude]
        assert relative_thrust == pytest.approx(float(row["efficiency"]), abs=0.002), row
