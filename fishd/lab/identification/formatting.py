"""Formatting of estimates in common units, with significant digits, for terminal and pages."""

import math

from fishd.lab.identification.result import PRODUCT_UNITS, Estimate

_OUTPUT_UNITS: dict[str, tuple[float, str]] = {
    "N": (1e3, "mN"),
    "s": (1e3, "ms"),
    "N s^2/rad^2": (1e3, "mN s²/rad²"),
    "N s^2/rad": (1e3, "mN s²/rad"),
    "N s/rad": (1e3, "mN s/rad"),
    "1": (1.0, ""),
}
"""Factor and unit of the output, by the unit of the configuration."""
_SYMBOLS = {
    "omega0": "ω₀",
    "xi": "ξ",
    "coupling": "λ",
    "servo_speed": "Ω",
    "servo_lag": "Δ",
    "thrust_coefficient": "K",
    "lateral_drag": "K_d",
    "lateral_inertia_ratio": "K_y/K",
    "quadratic_drag": "c",
    "lateral_quadratic_drag": "K_q",
}
_PRODUCTS = dict(zip(PRODUCT_UNITS, ("K λ²", "K_y λ", "K_d λ"), strict=True))


def format_estimate(estimate: Estimate) -> tuple[str, str, str, str]:
    """Return name, value, 95 % interval and unit; the unit of a pure number is empty.

    Where K_y/K widens the interval, the number of digits is that for a known ratio.
    """
    factor, unit = _unit(estimate)
    symbol = _SYMBOLS.get(estimate.name)
    name = f"{estimate.name} {symbol}" if symbol else _PRODUCTS.get(estimate.name, estimate.name)
    value = f"{factor * estimate.value:.{_digits(estimate.narrowest_interval, factor)}f}"
    if not math.isfinite(estimate.high):
        return name, value, "not identified", unit
    return name, value, _interval((estimate.low, estimate.high), factor), unit


def format_if_ratio_holds(estimate: Estimate) -> str:
    """Return the 95 % interval for a known K_y/K; empty where that makes no difference."""
    if not estimate.if_ratio_holds or not math.isfinite(estimate.high):
        return ""
    return _interval(estimate.if_ratio_holds, _unit(estimate)[0])


def _unit(estimate: Estimate) -> tuple[float, str]:
    """Return the factor and the unit of the output."""
    if estimate.name == "rotation":
        return math.degrees(1.0), "°"
    return _OUTPUT_UNITS.get(estimate.unit, (1.0, estimate.unit))


def _interval(ends: tuple[float, float], factor: float) -> str:
    digits = _digits(ends, factor)
    return f"{factor * ends[0]:.{digits}f} to {factor * ends[1]:.{digits}f}"


def _digits(ends: tuple[float, float], factor: float) -> int:
    """Return the number of decimals that shows two digits of the width of an interval."""
    width = factor * (ends[1] - ends[0])
    if not 0.0 < width < math.inf:
        return 4
    return min(6, max(0, 1 - math.floor(math.log10(max(width, 1e-9)))))
