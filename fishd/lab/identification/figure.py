"""Figure of an identification: forces, fit and residuals."""

import os
from typing import Any

import numpy as np

from fishd.lab.drawing import BLACK, BLUE, GREY, ORANGE, open_figure
from fishd.lab.identification.result import Fit, Identification
from fishd.lab.statistics import Z95

_EXTRACT_S = 6.0
"""Length of the extract that shows forces in detail [s]."""
_MAX_LAG = 40
"""Largest lag of the plotted correlation [ticks]."""


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
