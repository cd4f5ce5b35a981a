"""Optima of a fish: the best square wave, its limits, and the best command of any shape."""

from fishd.lab.optimum.optimal_control import OptimalControl, optimal_control
from fishd.lab.optimum.square_waves import (
    Optima,
    best_square_waves,
    fast_servo,
    saturation_amplitude,
    slow_servo,
)

__all__ = [
    "Optima",
    "OptimalControl",
    "best_square_waves",
    "fast_servo",
    "optimal_control",
    "saturation_amplitude",
    "slow_servo",
]
