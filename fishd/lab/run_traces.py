"""What the figures of a recording are drawn from: arrays against time, with a break at each gap."""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from fishd.core.errors import RecordingError
from fishd.core.signals import Event, Tick
from fishd.recording import Run

PORTRAIT = 20.0
"""The phase portrait is of so much swimming, the latest [s]."""
SHOWN = ("mark", "controller", "parameters", "fallback", "fault", "calibration")
"""Kinds of event that a figure shows."""

Array = NDArray[np.float64]


class Traces(NamedTuple):
    """A part of a recording; NaN where ticks are missing, and where a quantity is not known."""

    title: str
    unit: str
    """Of forces: mN, or mV until the sensor is calibrated."""
    time: Array
    """Since the first tick of the recording [s]."""
    fx: Array
    fy: Array
    """[`unit`]"""
    phi_c: Array
    """[rad]"""
    thrust: Array
    """As fishd told it, over whole beats [`unit`]."""
    thrust_error: Array
    """Half of its 95 % interval; NaN while the zero is not known [`unit`]."""
    frequency: Array
    """[Hz]"""
    fin_velocity: Array
    """As estimated; its scale is not known."""
    alpha: Array | None
    alpha_rate: Array | None
    """True fin angle and its rate, of a simulated fish [rad, rad/s]."""
    quantities: dict[str, Array]
    """The controller's own."""
    portrait: slice
    """The samples of the phase portrait."""
    events: list[tuple[float, Event]]
    """Events, and when they were, as `time`."""


def traces(run: Run, begin: float = 0.0, end: float = math.inf) -> Traces:
    """The part from `begin` to `end` [s]; raises `RecordingError` where nothing is in it."""
    first = run.ticks[0].t if run.ticks else 0.0
    chosen = [tick for tick in run.ticks if begin <= tick.t - first <= end]
    if not chosen:
        length = f"it is {run.summary.duration:.1f} s long"
        raise RecordingError(f"{run.path}: there is no tick between these times; {length}")
    rows = _with_breaks(chosen)

    def column(value: Callable[[Tick], object]) -> Array:
        found = (value(row) if isinstance(row, Tick) else math.nan for row in rows)
        return np.array([math.nan if v is UNSET else v for v in found], dtype=float)

    simulated = chosen[0].alpha is not UNSET
    time = np.array([(row.t if isinstance(row, Tick) else row) - first for row in rows])
    swims = [index for index, row in enumerate(rows) if isinstance(row, Tick) and _swims(row)]
    last = swims[-1] if swims else len(rows) - 1
    names = dict.fromkeys(name for tick in chosen for name in _quantities(tick))
    return Traces(
        title=_title(run),
        unit=f"m{run.summary.force_unit}",
        time=time,
        fx=1e3 * column(lambda tick: tick.fx),
        fy=1e3 * column(lambda tick: tick.fy),
        phi_c=column(lambda tick: tick.phi_c),
        thrust=1e3 * column(lambda tick: tick.thrust),
        thrust_error=1e3 * column(lambda tick: tick.thrust_error),
        frequency=column(lambda tick: tick.frequency),
        fin_velocity=column(lambda tick: tick.fin_velocity),
        alpha=column(lambda tick: tick.alpha) if simulated else None,
        alpha_rate=column(lambda tick: tick.alpha_rate) if simulated else None,
        quantities={
            name: column(lambda tick, name=name: _quantities(tick).get(name, math.nan))  # type: ignore[misc]
            for name in names
        },
        portrait=slice(int(np.searchsorted(time, time[last] - PORTRAIT)), last + 1),
        events=[
            (event.t - first, event)
            for event in run.events
            if event.kind in SHOWN and begin <= event.t - first <= end
        ],
    )


def _with_breaks(ticks: list[Tick]) -> list[Tick | float]:
    """The ticks, and between two that do not follow one another the time of a break."""
    rows: list[Tick | float] = []
    for before, tick in zip((None, *ticks), ticks, strict=False):
        if before is not None and tick.seq != before.seq + 1:
            rows.append(before.t)
        rows.append(tick)
    return rows


def _quantities(tick: Tick) -> dict[str, float]:
    return {} if tick.quantities is UNSET else tick.quantities


def _swims(tick: Tick) -> bool:
    return tick.mode == "running"


def _title(run: Run) -> str:
    about = (run.about.get("subject", ""), run.about.get("note", ""))
    summary = run.summary
    lost = f", ticks lost: {summary.lost}" if summary.lost else ""
    what = "; ".join((run.name, *filter(None, about)))
    return f"{what} ({', '.join(summary.swimming) or 'at rest'}{lost})"
