"""Presentation of an identification: its estimates as text, and a figure of forces and fit."""

import math
import os
from typing import Any

import numpy as np

from fishd.lab.drawing import BLACK, BLUE, GREY, ORANGE, open_figure
from fishd.lab.identification.result import PRODUCT_UNITS, Estimate, Fit, Identification
from fishd.lab.statistics import Z95

_EXTRACT_S = 6.0
"""Length of the extract that shows forces in detail [s]."""
_MAX_LAG = 40
"""Largest lag of the plotted correlation [ticks]."""
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


def draw(identification: Identification, path: str | os.PathLike[str]) -> None:
    """Draw an identification into a file; raises `FishdError` where it cannot be written."""
    with open_figure(path, (10.0, 6.5)) as figure:
        axes = figure.subplots(2, 3, width_ratios=(3.0, 3.0, 1.6))
        for channel, (row, symbol) in enumerate(zip(axes, ("F_x", "F_y"), strict=True)):
            _draw_forces(row[0], identification.fit, channel, symbol)
            residual = 1e3 * (identification.fit.measured - identification.fit.simulated)[channel]
            drift = 1e3 * identification.fit.drift[channel]
            _draw_residual(row[1], identification, channel, residual, drift)
            _draw_correlation(row[2], residual - drift)
        handles = [line for axis in axes[1][:2] for line in axis.get_legend_handles_labels()[0]]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))


def _draw_forces(axis: Any, fit: Fit, channel: int, symbol: str) -> None:
    """Plot an extract of measured forces, and of the fit with the drift of the sensor."""
    middle = np.nanmedian(fit.times)
    extract = np.abs(fit.times - middle) <= 0.5 * _EXTRACT_S
    times = fit.times[extract]
    simulated = 1e3 * (fit.simulated + fit.drift)[channel, extract]
    style = {"color": BLACK, "markersize": 3.0, "linestyle": "none"}
    axis.plot(times, 1e3 * fit.measured[channel, extract], marker=".", label="measured", **style)
    axis.plot(times, simulated, color=BLUE, linewidth=0.9, label="identified fish + drift")
    axis.set_ylabel(f"${symbol}$ (mN)")
    axis.set_xlabel("time (s)")
    axis.set_title(f"${symbol}$, mean of each tick")


def _draw_residual(
    axis: Any, identification: Identification, channel: int, residual: Any, drift: Any
) -> None:
    result = identification.channels[channel]
    axis.plot(
        identification.fit.times,
        residual,
        color=GREY,
        linewidth=0.4,
        label="measured − identified fish",
    )
    axis.plot(
        identification.fit.times, drift, color=ORANGE, linewidth=1.2, label="offset and drift"
    )
    axis.set_ylabel("residual (mN)")
    axis.set_xlabel("time (s)")
    title = f"{result.explained:.2%} explained, noise {result.noise * 1e3:.2f} mN"
    axis.set_title(title)


def _draw_correlation(axis: Any, residual: Any) -> None:
    """Plot the correlation of the residual without drift, with the bounds for white noise."""
    finite = residual[np.isfinite(residual)]
    finite = finite - finite.mean()
    lags = range(1, min(_MAX_LAG, len(finite) - 1) + 1)
    squares = float(finite @ finite)
    correlations = [float(finite[lag:] @ finite[:-lag]) / squares for lag in lags]
    axis.vlines(lags, 0.0, correlations, color=BLUE, linewidth=1.5)
    for end in (-Z95, Z95):
        axis.axhline(end / np.sqrt(len(finite)), color=GREY, linewidth=0.8, linestyle="--")
    axis.axhline(0.0, color=GREY, linewidth=0.6)
    axis.set_ylim(-0.3, 0.3)
    axis.set_xlabel("ticks between")
    axis.set_title("its correlation")


def format_estimate(estimate: Estimate) -> tuple[str, str, str, str]:
    """Return name, value, 95 % interval and unit; the unit of a pure number is empty.

    Where K_y/K widens the interval, the number of digits is that for a known ratio.
    """
    factor, unit = _unit(estimate)
    symbol = _SYMBOLS.get(estimate.name)
    name = f"{estimate.name} {symbol}" if symbol else _PRODUCTS.get(estimate.name, estimate.name)
    value = f"{factor * estimate.value:.{_digits(estimate.narrowest_interval, factor)}f}"
    if not math.isfinite(estimate.ci95_high):
        return name, value, "not identified", unit
    return name, value, _interval((estimate.ci95_low, estimate.ci95_high), factor), unit


def format_if_ratio_holds(estimate: Estimate) -> str:
    """Return the 95 % interval for a known K_y/K; empty where that makes no difference."""
    if not estimate.if_ratio_holds or not math.isfinite(estimate.ci95_high):
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
