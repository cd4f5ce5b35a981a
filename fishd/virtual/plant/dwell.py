"""Shortest useful time between two reversals, from the identified servo."""

import math

from fishd.virtual.plant.drive_train import time_between
from fishd.virtual.plant.parameters import PlantParameters

REVERSAL_FRACTION = 0.9
"""Fraction of the wheel's way after which a reversal counts as complete."""
MIN_HALF_BEAT_FRACTION, MAX_HALF_BEAT_FRACTION = 0.6, 0.8
"""Smallest and largest dwell, as fractions of a half beat of the best square wave."""


def shortest_dwell(parameters: PlantParameters, amplitude: float) -> float:
    """Return the time that the servo takes for a reversal, from the command on [s].

    amplitude: Φ [rad]

    The fin sets bounds, so that a servo with a long delay can still perform the best square wave,
    and a fast servo cannot shake the fin. A half beat of that wave lasts π/ω₀ with a fast servo and
    2Φ/Ω with a slow one (Fu et al.), and longer in between.
    """
    p = parameters
    lag = 2.0 * amplitude / p.servo_lag
    turn = p.servo_lag / p.servo_speed * time_between(lag, (1.0 - REVERSAL_FRACTION) * lag)
    half_beat = max(math.pi / p.omega0, 2.0 * amplitude / p.servo_speed)
    return min(
        max(p.servo_delay + turn, MIN_HALF_BEAT_FRACTION * half_beat),
        MAX_HALF_BEAT_FRACTION * half_beat,
    )
