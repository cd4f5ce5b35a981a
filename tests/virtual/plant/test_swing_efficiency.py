from collections.abc import Callable

import pytest

from fishd.virtual.plant.optimum import best_square_wave
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.tethered import TetheredFish

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


def test_swinging_control_has_the_reference_efficiency_at_every_threshold(
    reference: Callable[[str], list[dict[str, str]]],
) -> None:
    p = PlantParameters()
    best = {}
    for row in reference("swing_efficiency"):
        amplitude, threshold = float(row["Phi_rad"]), float(row["C"])
        if amplitude not in best:
            best[amplitude] = best_square_wave(p, amplitude).thrust
        efficiency = swing_thrust(p, amplitude, threshold) / best[amplitude]
        assert efficiency == pytest.approx(float(row["efficiency"]), abs=0.002), row
