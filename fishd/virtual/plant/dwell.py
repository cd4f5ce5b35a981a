"""How soon after a reversal another one can do any good: from the servo, as it was identified."""

import math

from fishd.virtual.plant.drive_train import time_between
from fishd.virtual.plant.parameters import PlantParameters

TURNED = 0.9
"""A reversal is done when the wheel has turned by this share of its way."""
LEAST, MOST = 0.6, 0.8
"""Of a half beat of the best square wave: a dwell is no smaller and no larger share of it."""


def shortest_dwell(parameters: PlantParameters, amplitude: float) -> float:
    """The time that the servo takes for a reversal, from the command on [s].

    amplitude: Φ [rad]

    The fin needs its time, too, and sets bounds: a servo with a long delay does not forbid the best
    square wave, nor does a fast one permit to shake the fin. The half beats of that wave last π/ω₀
    with a fast servo and 2Φ/Ω with a slow one (Fu et al.), and longer in between.
    """
    p = parameters
    lag = 2.0 * amplitude / p.servo_lag
    turn = p.servo_lag / p.servo_speed * time_between(lag, (1.0 - TURNED) * lag)
    half_beat = max(math.pi / p.omega0, 2.0 * amplitude / p.servo_speed)
    return min(max(p.servo_delay + turn, LEAST * half_beat), MOST * half_beat)
