"""Estimates in the units and with the digits that people read, for the terminal and for pages."""

import math

from fishd.lab.identification.result import Estimate

_SHOWN: dict[str, tuple[float, str]] = {
    "N": (1e3, "mN"),
    "s": (1e3, "ms"),
    "N s^2/rad^2": (1e3, "mN s²/rad²"),
    "N s/rad": (1e3, "mN s/rad"),
    "1": (1.0, ""),
}
"""Factor and unit that stand for a unit of the configuration."""
_SYMBOLS = {
    "omega0": "ω₀",
    "xi": "ξ",
    "coupling": "λ",
    "servo_speed": "Ω",
    "servo_lag": "Δ",
    "thrust_coefficient": "K",
    "lateral_drag": "K_d",
}


def format_estimate(estimate: Estimate) -> tuple[str, str, str, str]:
    """Return name, value, 95 % interval and unit; the unit of a pure number is empty."""
    factor, unit = _SHOWN.get(estimate.unit, (1.0, estimate.unit))
    if estimate.name == "rotation":
        factor, unit = math.degrees(1.0), "°"
    symbol = _SYMBOLS.get(estimate.name)
    value, low, high = (factor * x for x in (estimate.value, estimate.low, estimate.high))
    # Two digits of what is not known.
    width = high - low
    known = 0.0 < width < math.inf
    digits = max(0, 1 - math.floor(math.log10(max(width, 1e-9)))) if known else 4
    shown = [f"{x:.{min(digits, 6)}f}" for x in (value, low, high)]
    name = f"{estimate.name} {symbol}" if symbol else estimate.name
    return name, shown[0], f"{shown[1]} to {shown[2]}", unit
