"""A recording as an interactive page: one .html file that needs no network."""

import os
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from plotly.graph_objects import Figure, Scattergl
from plotly.subplots import make_subplots

from fishd.core import text
from fishd.core.errors import RecordingError
from fishd.core.files import write_atomically
from fishd.lab.drawing import BLACK, BLUE, GREEN, ORANGE, PURPLE
from fishd.lab.run_traces import (
    MIN_ANGLE_SPAN,
    MIN_FORCE_SPAN,
    MIN_QUANTITY_SPAN,
    PORTRAIT_S,
    Traces,
    limits,
)

_PORTRAIT_ROWS = 2
"""Height of the phase portrait, in heights of the other plots."""


def write_page(traces: Traces, path: str | os.PathLike[str]) -> None:
    """Write the page; raises `RecordingError` where this fails."""
    traces = _escape_texts(traces)
    titles = ["forces", "command", "thrust", *traces.quantities]
    heights = [1] * len(titles)
    if traces.portrait:
        titles.append(f"phase portrait, last {PORTRAIT_S:g} s of swimming")
        heights.append(_PORTRAIT_ROWS)
    rows = len(titles)
    figure = make_subplots(
        rows=rows,
        cols=1,
        row_heights=heights,
        vertical_spacing=0.4 / rows,
        subplot_titles=titles,
    )
    _add_lines(figure, traces)
    over_time = len(heights) - bool(traces.portrait)
    if traces.portrait:
        _add_portrait(figure, traces, traces.portrait, rows)
    for row in range(1, over_time + 1):
        figure.update_xaxes(matches="x", row=row, col=1)
    figure.update_xaxes(title_text="time (s)", row=over_time, col=1)
    # All at once: plotly takes seconds to add twenty lines one by one.
    lowest = figure.layout[f"yaxis{over_time}"].domain[0]
    lines = [
        {
            "type": "line",
            "xref": "x",
            "yref": "paper",
            "x0": event.time,
            "x1": event.time,
            "y0": lowest,
            "y1": 1,
            "line": {
                "color": PURPLE if event.kind == "mark" else "grey",
                "width": 1,
                "dash": "dot",
            },
        }
        for event in traces.events
    ]
    labels = [
        {
            "x": event.time,
            "y": 1,
            "xref": "x",
            "yref": "y domain",
            "text": event.text,
            "showarrow": False,
            "xanchor": "left",
        }
        for event in traces.events
    ]
    figure.update_layout(
        shapes=lines,
        annotations=[*figure.layout.annotations, *labels],
        title=traces.title,
        height=190 * (1 + sum(heights)),
        template="plotly_white",
        hovermode="x unified",
    )
    try:
        write_atomically(Path(path), figure.to_html(include_plotlyjs=True))
    except OSError as error:
        raise RecordingError(f"{path} cannot be written: {error.strerror or error}") from None


def _add_lines(figure: Figure, traces: Traces) -> None:
    def add(row: int, name: str, values: Any, colour: str, **line: Any) -> None:
        figure.add_trace(
            Scattergl(
                x=traces.time,
                y=values,
                name=name,
                mode="lines",
                line={"color": colour, "width": 1.2, **line},
            ),
            row=row,
            col=1,
        )

    add(1, f"F_x ({traces.unit})", traces.fx, BLUE)
    add(1, f"F_y ({traces.unit})", traces.fy, ORANGE)
    add(2, "command φ_c (rad)", traces.phi_c, BLACK, shape="hv")
    if traces.alpha is not None:
        add(2, "true fin angle α (rad)", traces.alpha, GREEN)
    add(3, f"thrust over whole beats ({traces.unit})", traces.thrust, BLUE)
    known = np.isfinite(traces.thrust_ci95).any()
    for sign in (-1, 1) if known else ():
        edge = traces.thrust + sign * traces.thrust_ci95
        add(3, f"{'−+'[sign > 0]} 95 %", edge, BLUE, dash="dot")
    for row, (name, values) in enumerate(traces.quantities.items(), start=4):
        add(row, name, values, GREEN)
        figure.update_yaxes(range=limits(MIN_QUANTITY_SPAN, values), row=row, col=1)
    error = traces.thrust_ci95
    angles = [traces.phi_c] if traces.alpha is None else [traces.phi_c, traces.alpha]
    axes = (
        (traces.unit, limits(MIN_FORCE_SPAN, traces.fx, traces.fy)),
        ("rad", limits(MIN_ANGLE_SPAN, *angles)),
        (traces.unit, limits(MIN_FORCE_SPAN, *(traces.thrust + k * error for k in (-1, 0, 1)))),
    )
    for row, (unit, span) in enumerate(axes, start=1):
        figure.update_yaxes(title_text=unit, range=span, row=row, col=1)


def _add_portrait(figure: Figure, traces: Traces, chosen: slice, row: int) -> None:
    if traces.alpha is not None and traces.alpha_rate is not None:
        x, y = traces.alpha, traces.alpha_rate
        names = "true fin angle α (rad)", "its rate (rad/s)"
    else:
        x, y = traces.fin_velocity, traces.fy
        names = "fin velocity, as estimated", f"F_y ({traces.unit})"
    line = Scattergl(
        x=x[chosen],
        y=y[chosen],
        text=[f"{time:.2f} s" for time in traces.time[chosen]],
        mode="lines+markers",
        marker={"size": 3},
        line={"color": GREEN, "width": 1},
        name="phase portrait",
    )
    figure.add_trace(line, row=row, col=1)
    figure.update_xaxes(title_text=names[0], row=row, col=1)
    figure.update_yaxes(title_text=names[1], row=row, col=1)


def _escape_texts(traces: Traces) -> Traces:
    """Return the traces with texts in which plotly finds no HTML tags."""
    return traces._replace(
        title=escape(text.line(traces.title), quote=False),
        unit=escape(traces.unit, quote=False),
        quantities={
            escape(name, quote=False): values for name, values in traces.quantities.items()
        },
        events=[event._replace(text=escape(event.text, quote=False)) for event in traces.events],
    )
