"""Presentation of an identification: its estimates as text, and a figure of forces and fit."""

import math
import os
from typing import Any, NamedTuple

import numpy as np

from fishd.lab.drawing import BLACK, BLUE, GREY, ORANGE, open_figure
from fishd.lab.identification.response import Array
from fishd.lab.identification.result import (
    PRODUCT_UNITS,
    Channel,
    Estimate,
    FinAngleFit,
    Identification,
)
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
    fit, tail = identification.fit, identification.fin_angle
    outputs = [
        _Output(
            f"$F_{axis}$",
            "mN",
            fit.times,
            fit.measured[k],
            fit.simulated[k],
            fit.drift[k],
            identification.channels[k],
        )
        for k, axis in enumerate("xy")
    ]
    if tail:
        none = np.zeros(len(tail.times))
        outputs.append(_Output("α", "mrad", tail.times, tail.measured, tail.simulated, none, tail))
    with open_figure(path, (10.0, 3.25 * len(outputs))) as figure:
        axes = figure.subplots(len(outputs), 3, width_ratios=(3.0, 3.0, 1.6))
        for row, output in zip(axes, outputs, strict=True):
            _draw_extract(row[0], output)
            _draw_residual(row[1], output)
            _draw_correlation(row[2], output.residual - output.drift)
        handles = [line for axis in axes[0][:2] for line in axis.get_legend_handles_labels()[0]]
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))


class _Output(NamedTuple):
    """Forces or fin angles, and those of the identified fish; arrays of equal length."""

    symbol: str
    unit: str
    """Thousandth of the unit of the arrays."""
    times: Array
    measured: Array
    simulated: Array
    drift: Array
    result: Channel | FinAngleFit

    @property
    def residual(self) -> Array:
        """Return what is measured minus that of the fish, with the drift."""
        return np.asarray(self.measured - self.simulated)


def _draw_extract(axis: Any, output: _Output) -> None:
    """Plot an extract of what was measured, and of the fit with the drift of the sensor."""
    times = output.times
    extract = np.abs(times - np.nanmedian(times)) <= 0.5 * _EXTRACT_S
    style = {"color": BLACK, "markersize": 3.0, "linestyle": "none"}
    axis.plot(times[extract], 1e3 * output.measured[extract], marker=".", label="measured", **style)
    simulated = 1e3 * (output.simulated + output.drift)[extract]
    axis.plot(times[extract], simulated, color=BLUE, linewidth=0.9, label="identified fish + drift")
    axis.set_ylabel(f"{output.symbol} ({output.unit})")
    axis.set_xlabel("time (s)")
    each = "each picture" if isinstance(output.result, FinAngleFit) else "mean of each tick"
    axis.set_title(f"{output.symbol}, {each}")


def _draw_residual(axis: Any, output: _Output) -> None:
    """Plot what the fish does not explain, and the drift."""
    style = {"color": GREY, "linewidth": 0.4, "label": "measured − identified fish"}
    axis.plot(output.times, 1e3 * output.residual, **style)
    if np.any(output.drift):
        style = {"color": ORANGE, "linewidth": 1.2, "label": "offset and drift"}
        axis.plot(output.times, 1e3 * output.drift, **style)
    axis.set_ylabel(f"residual ({output.unit})")
    axis.set_xlabel("time (s)")
    result = output.result
    noise = f"{result.noise * 1e3:.2f} {output.unit}"
    axis.set_title(f"{result.explained:.2%} explained, noise {noise}")


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
