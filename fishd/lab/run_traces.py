"""What the figures of a recording are drawn from: arrays against time, with a break at each gap."""

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from fishd.controllers import registry
from fishd.core import text
from fishd.core.errors import RecordingError, UnknownController
from fishd.core.schema import format_values
from fishd.core.signals import Event, Tick
from fishd.recording import Run

PORTRAIT = 20.0
"""The phase portrait is of so much swimming, the latest [s]."""
LEAST_FORCE, LEAST_ANGLE, LEAST_QUANTITY = 1.0, 0.1, 1e-3
"""No axis spans less, so that numerical dust does not look like a signal [mN or mV, rad, any]."""
SHOWN = ("mark", "controller", "parameters", "fallback", "fault", "calibration")
"""Kinds of event that a figure shows."""

LONGEST_TEXT = 48
"""Of an event [characters]."""
LONGEST_NAME, LONGEST_UNIT = 24, 8
"""Of a quantity, and of the forces; longer ones leave a panel no room [characters]."""
MAX_QUANTITIES = 12
"""Quantities of controllers in one figure; of more, the first are drawn."""
MAX_EVENTS = 500
"""Events in one figure; of more, the first are drawn."""
MAX_VALUE = 1e12
"""Largest number that is drawn; larger ones are refused [N, rad, s, any]."""

Array = NDArray[np.float64]


class Shown(NamedTuple):
    """An event in a figure."""

    time: float
    """As `Traces.time` [s]."""
    kind: str
    text: str
    """Which controller, which parameters changed to what, or what a mark says."""


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
    """The controller's own, by name and unit, as in `since_reversal (s)`."""
    portrait: slice | None
    """The samples of the phase portrait; None where no controller swam."""
    events: list[Shown]


def traces(run: Run, begin: float = 0.0, end: float = math.inf) -> Traces:
    """The part from `begin` to `end` [s]; raises `RecordingError` where nothing is in it."""
    first = run.ticks[0].t if run.ticks else 0.0
    chosen = [tick for tick in run.ticks if begin <= tick.t - first <= end]
    if not chosen:
        length = f"it is {run.summary.duration:.1f} s long"
        raise RecordingError(f"{run.path}: there is no tick between these times; {length}")
    rows = _with_breaks(chosen)

    def column(name: str, value: Callable[[Tick], object] | None = None) -> Array:
        get = value or attrgetter(name)
        found = (get(row) if isinstance(row, Tick) else math.nan for row in rows)
        values = np.array([math.nan if v is UNSET else v for v in found], dtype=float)
        return _checked(run, name, values)

    def quantity(name: str) -> Array:
        return column(name, lambda tick: _quantities(tick).get(name, math.nan))

    simulated = chosen[0].alpha is not UNSET
    times = [(row.t if isinstance(row, Tick) else row) - first for row in rows]
    time = _checked(run, "the time of a tick", np.array(times))
    swims = [index for index, row in enumerate(rows) if isinstance(row, Tick) and _swims(row)]
    units = _units({tick.controller for tick in chosen})
    names = dict.fromkeys(name for tick in chosen for name in _quantities(tick))
    events = [event for event in _shown(run.events, first) if begin <= event.time <= end]
    _checked(run, "the time of an event", np.array([event.time for event in events]))
    left_out = [
        f"{len(whole) - most} {what} not drawn"
        for whole, most, what in (
            (names, MAX_QUANTITIES, "quantities"), (events, MAX_EVENTS, "events")
        )
        if len(whole) > most
    ]  # fmt: skip
    return Traces(
        title="; ".join((_title(run), *left_out)),
        unit=f"m{text.line(run.summary.force_unit, LONGEST_UNIT)}",
        time=time,
        fx=1e3 * column("fx"),
        fy=1e3 * column("fy"),
        phi_c=column("phi_c"),
        thrust=1e3 * column("thrust"),
        thrust_error=1e3 * column("thrust_error"),
        frequency=column("frequency"),
        fin_velocity=column("fin_velocity"),
        alpha=column("alpha") if simulated else None,
        alpha_rate=column("alpha_rate") if simulated else None,
        quantities={
            f"{text.line(name, LONGEST_NAME)} ({units.get(name, '1')})": quantity(name)
            for name in list(names)[:MAX_QUANTITIES]
        },
        portrait=_portrait(time, swims),
        events=events[:MAX_EVENTS],
    )


def limits(least: float, *curves: Array) -> tuple[float, float]:
    """Ends of an axis with room for these curves, and of a span that is not less than `least`."""
    values = np.concatenate(curves)
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    room = max(0.05 * (high - low), (least - (high - low)) / 2)
    return low - room, high + room


def _checked(run: Run, name: str, values: Array) -> Array:
    """The values; raises `RecordingError` where one of them is too large to be drawn."""
    if np.any(np.abs(values) > MAX_VALUE):
        raise RecordingError(
            f"{run.path}: {text.quoted(name)} is {np.nanmax(np.abs(values)):.3g} somewhere, which "
            "cannot be drawn; leave it out with --from and --until"
        )
    return values


def _portrait(time: Array, swims: list[int]) -> slice | None:
    if not swims:
        return None
    last = swims[-1]
    return slice(int(np.searchsorted(time, time[last] - PORTRAIT)), last + 1)


def _units(controllers: Iterable[str]) -> dict[str, str]:
    """Units of the quantities of these controllers, as far as they are installed here."""
    units: dict[str, str] = {}
    for name in sorted(controllers):
        with suppress(UnknownController):
            units |= {each.name: each.unit for each in registry.describe(name).quantities}
    return units


def _shown(events: Iterable[Event], first: float) -> Iterator[Shown]:
    before: dict[str, Any] = {}
    for event in events:
        if event.kind not in SHOWN:
            continue
        words, parameters = event.kind, event.data.get("parameters")
        if isinstance(parameters, dict):
            takes_over = event.kind != "parameters"
            changed = {
                name: value
                for name, value in parameters.items()
                if (value is not None if takes_over else value != before.get(name))
            }
            controller = str(event.data.get("controller", event.kind))
            settings = format_values(changed, registry.units(controller))
            words = f"{controller} {settings}".rstrip() if takes_over else settings or event.kind
            before = parameters
        elif event.kind == "mark":
            words = event.message
        elif event.kind == "fault":
            words = f"fault {event.data.get('code', '')}".strip()
        yield Shown(event.t - first, event.kind, text.line(words, LONGEST_TEXT))


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
