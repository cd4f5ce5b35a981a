"""Data for the figures of a recording: arrays against time, with a break at each gap."""

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray
from scipy.signal import periodogram

from fishd.camera.tail.beats import Beat, find_maxima
from fishd.controllers import registry
from fishd.core import text
from fishd.core.errors import RecordingError, UnknownController
from fishd.core.schema import format_values
from fishd.core.signals import Tick
from fishd.recording import Run
from fishd.recording.fin_angle import MAX_GAP_S, interpolate

PORTRAIT_S = 20.0
"""Length of the phase portrait, at the end of the latest swim [s]."""
MIN_SPECTRUM_S, MIN_SPECTRUM_TICKS = 2.0, 16
"""Shortest part of a swim that has a spectrum [s, ticks]."""
MIN_FORCE_SPAN, MIN_ANGLE_SPAN, MIN_QUANTITY_SPAN = 1.0, 0.1, 1e-3
"""Shortest spans of axes, so that rounding errors do not look like signals [mN or mV, rad, any]."""
SHOWN_EVENTS = ("mark", "controller", "parameters", "fallback", "fault", "calibration")
"""Kinds of event that a figure shows."""

MAX_TEXT_CHARS = 48
"""Length of the longest text of an event [characters]."""
MAX_NAME_CHARS, MAX_UNIT_CHARS = 24, 8
"""Length of the longest name of a quantity and unit of a force; panels are small [characters]."""
MAX_QUANTITIES = 12
"""Largest number of controller quantities in one figure; further ones are left out."""
MAX_EVENTS = 500
"""Largest number of events in one figure; further ones are left out."""
MAX_VALUE = 1e12
"""Largest value that can be drawn; larger ones are refused [N, rad, s, any]."""

Array = NDArray[np.float64]


class EventLabel(NamedTuple):
    """An event in a figure."""

    time: float
    """Time since the first tick of the recording [s]."""
    kind: str
    text: str
    """Name of the controller with parameters, changed parameters, or text of a mark."""


class FinAngle(NamedTuple):
    """Fin angle that a camera has measured."""

    time: Array
    """Times of the pictures, since the first tick of the recording [s]."""
    alpha: Array
    """Fin angle in the pictures, with NaN where it is unknown and in gaps [rad]."""
    at_ticks: Array
    """Fin angle at each time of the ticks [rad]."""
    beats: list[Beat]
    """Whole beats, with the largest fin angle of each."""


class Traces(NamedTuple):
    """A part of a recording; NaN where ticks are missing, and where a quantity is unknown."""

    title: str
    unit: str
    """Unit of forces: mN, or mV until the sensor is calibrated."""
    time: Array
    """Time since the first tick of the recording [s]."""
    fx: Array
    """F_x [`unit`]."""
    fy: Array
    """F_y [`unit`]."""
    phi_c: Array
    """Command φ_c [rad]."""
    thrust: Array
    """Mean thrust over whole beats, as fishd published it [`unit`]."""
    thrust_ci95: Array
    """Half-width of the 95 % interval of `thrust`; NaN while the zero is unknown [`unit`]."""
    frequency: Array
    """Frequency of the tail beat [Hz]."""
    fin_velocity: Array
    """Estimated velocity of the fin, in an unknown unit."""
    alpha: Array | None
    alpha_rate: Array | None
    """True fin angle and its rate [rad, rad/s]; None for a real fish."""
    quantities: dict[str, Array]
    """Readings and quantities of the controller by name and unit, as in `power (W)` or `phase`."""
    portrait: slice | None
    """Samples of the phase portrait; None where no controller swam."""
    events: list[EventLabel]
    fin: FinAngle | None = None
    """Measured fin angle; None without a camera that measured it."""

    @property
    def force_time(self) -> Array:
        """Times of the centres of the intervals of which the forces are means [s]."""
        steps = np.diff(self.time)
        return self.time - 0.5 * float(np.median(steps)) if len(steps) else self.time


def traces(run: Run, begin: float = 0.0, end: float = math.inf) -> Traces:
    """Return the part from `begin` to `end` [s]; raises `RecordingError` where it is empty."""
    pairs = zip(run.ticks, run.times_of("tick"), strict=True)
    kept = [(tick, time) for tick, time in pairs if begin <= time <= end]
    if not kept:
        length = f"the recording is {run.summary.duration:.1f} s long"
        raise RecordingError(f"{run.path}: no tick between these times; {length}")
    chosen = [tick for tick, _ in kept]
    rows, times = zip(*_with_breaks(kept), strict=True)

    def column(name: str, value: Callable[[Tick], object] | None = None) -> Array:
        get = value or attrgetter(name)
        raw_values = (math.nan if row is None else get(row) for row in rows)
        values = np.array([math.nan if v is UNSET else v for v in raw_values], dtype=float)
        return _checked(run, name, values)

    def quantity(name: str) -> Array:
        return column(name, lambda tick: _quantities(tick).get(name, math.nan))

    simulated = chosen[0].alpha is not UNSET
    time = _checked(run, "the time of a tick", np.array(times))
    swims = [index for index, row in enumerate(rows) if row is not None and _swims(row)]
    units = _units({tick.controller for tick in chosen}) | run.reading_units
    names = dict.fromkeys(name for tick in chosen for name in _quantities(tick))
    events = [event for event in _label_events(run) if begin <= event.time <= end]
    _checked(run, "the time of an event", np.array([event.time for event in events]))
    left_out = [
        f"{len(items) - maximum} {kind} not drawn"
        for items, maximum, kind in (
            (names, MAX_QUANTITIES, "quantities"), (events, MAX_EVENTS, "events")
        )
        if len(items) > maximum
    ]  # fmt: skip
    return Traces(
        title="; ".join((_title(run), *left_out)),
        unit=f"m{text.line(run.summary.force_unit, MAX_UNIT_CHARS)}",
        time=time,
        fx=1e3 * column("fx"),
        fy=1e3 * column("fy"),
        phi_c=column("phi_c"),
        thrust=1e3 * column("thrust"),
        thrust_ci95=1e3 * column("thrust_ci95"),
        frequency=column("frequency"),
        fin_velocity=column("fin_velocity"),
        alpha=column("alpha") if simulated else None,
        alpha_rate=column("alpha_rate") if simulated else None,
        quantities={
            _label_quantity(name, units.get(name, "1")): quantity(name)
            for name in list(names)[:MAX_QUANTITIES]
        },
        portrait=_portrait(time, swims),
        events=events[:MAX_EVENTS],
        fin=_fin_angle(run, rows, time) if run.tails else None,
    )


def _fin_angle(run: Run, rows: tuple[Tick | None, ...], time: Array) -> FinAngle:
    """Return the measured fin angle within the times of these ticks.

    rows: ticks, and None at breaks; time: their times since the first tick of the recording [s]
    """
    clock = np.array([math.nan if row is None else row.time for row in rows])
    known = np.isfinite(clock)
    tails = [tail for tail in run.tails if clock[known][0] <= tail.time <= clock[known][-1]]
    table = np.array([(t.time, math.nan if t.alpha is None else t.alpha) for t in tails])
    seen, alpha = table.reshape(-1, 2).T
    gaps = np.flatnonzero(np.diff(seen) > MAX_GAP_S) + 1
    at_ticks, _ = interpolate(tails, clock)
    elapsed = np.interp(seen, clock[known], time[known])
    return FinAngle(
        np.insert(elapsed, gaps, elapsed[gaps]),
        _checked(run, "fin_angle", np.insert(alpha, gaps, math.nan)),
        _checked(run, "fin_angle", at_ticks),
        find_maxima(elapsed.tolist(), alpha.tolist()),
    )


class Spectrum(NamedTuple):
    """Amplitudes and power spectral densities of the forces over frequency."""

    frequency: Array
    """Frequency, without zero [Hz]."""
    fx: Array
    """Amplitude of F_x [unit of the forces]; a peak has the amplitude of its sine wave."""
    fy: Array
    """Amplitude of F_y [unit of the forces]."""
    fx_density: Array
    """One-sided power spectral density of F_x [(unit of the forces)²/Hz]."""
    fy_density: Array
    """One-sided power spectral density of F_y [(unit of the forces)²/Hz]."""


def spectrum(traces: Traces, samples: slice) -> Spectrum | None:
    """Return the spectrum of the forces after the last gap; None where fewer than 2 s are left.

    A flat-top window gives amplitudes that are right to 0.1 % between the frequencies of the
    spectrum, too; for the density a Hann window has the finer resolution. Both are those of means
    over a tick T, in which a frequency f is weaker by sinc(f T).
    """
    time, _, *forces = _after_last_gap(traces, samples)
    if len(time) < MIN_SPECTRUM_TICKS or time[-1] - time[0] < MIN_SPECTRUM_S:
        return None
    rate = (len(time) - 1) / (time[-1] - time[0])
    frequency, powers = periodogram(forces, rate, "flattop", scaling="spectrum")
    _, densities = periodogram(forces, rate, "hann", scaling="density")
    return Spectrum(frequency[1:], *np.sqrt(2.0 * powers[:, 1:]), *densities[:, 1:])


class MeanBeat(NamedTuple):
    """Means of the forces over the beats of the tail."""

    phase: Array
    """Phase of the beat, from 0, where φ_c becomes positive, to 1."""
    fx: Array
    """F_x [unit of the forces]; the mean over phase is that over all beats."""
    fy: Array
    """F_y [unit of the forces]."""


def mean_beat(traces: Traces, samples: slice) -> MeanBeat | None:
    """Return the mean beat after the last gap; None where there are fewer than two beats.

    A force of a tick is the mean since the tick before, so its integral over time is known at
    each tick. Each beat is cut into parts of equal phase, about one for each tick, whose means
    follow from that integral. φ_c holds from its tick to the next; a beat begins where it becomes
    positive, between the centres of two such intervals.
    """
    time, phi_c, *forces = _after_last_gap(traces, samples)
    before = np.flatnonzero((phi_c[:-2] <= 0.0) & (phi_c[1:-1] > 0.0))
    if len(before) < 3:
        return None
    centres = 0.5 * (time[1:] + time[:-1])
    share = phi_c[before] / (phi_c[before] - phi_c[before + 1])
    starts = centres[before] + share * (centres[before + 1] - centres[before])
    parts = round((starts[-1] - starts[0]) / (len(starts) - 1) / float(np.median(np.diff(time))))
    ends = np.interp(np.arange(parts * (len(starts) - 1) + 1) / parts, range(len(starts)), starts)
    lengths = np.diff(ends).reshape(-1, parts).sum(axis=0)

    def mean(force: Array) -> Array:
        integral = np.concatenate(([0.0], np.cumsum(force[1:] * np.diff(time))))
        pieces = np.diff(np.interp(ends, time, integral)).reshape(-1, parts)
        means: Array = pieces.sum(axis=0) / lengths
        return means

    return MeanBeat((np.arange(parts) + 0.5) / parts, mean(forces[0]), mean(forces[1]))


def _after_last_gap(traces: Traces, samples: slice) -> tuple[Array, Array, Array, Array]:
    """Return time, φ_c, F_x and F_y of the samples after their last gap."""
    gaps = np.flatnonzero(np.isnan(traces.fx[samples]))
    first = int(gaps[-1]) + 1 if len(gaps) else 0
    time, phi_c, fx, fy = (
        column[samples][first:] for column in (traces.time, traces.phi_c, traces.fx, traces.fy)
    )
    return time, phi_c, fx, fy


def limits(least: float, *curves: Array) -> tuple[float, float]:
    """Return the ends of an axis with a margin around curves, and a span of `least` or more."""
    values = np.concatenate(curves)
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if len(values) else (0.0, 0.0)
    room = max(0.05 * (high - low), (least - (high - low)) / 2)
    return low - room, high + room


def _checked(run: Run, name: str, values: Array) -> Array:
    """Return the values; raises `RecordingError` where one of them is too large to be drawn."""
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
    return slice(int(np.searchsorted(time, time[last] - PORTRAIT_S)), last + 1)


def _label_quantity(name: str, unit: str) -> str:
    label = text.line(name, MAX_NAME_CHARS)
    return label if unit == "1" else f"{label} ({unit})"


def _units(controllers: Iterable[str]) -> dict[str, str]:
    """Return the units of controller quantities, by name, for the controllers installed here."""
    units: dict[str, str] = {}
    for name in sorted(controllers):
        with suppress(UnknownController):
            units |= {
                quantity.name: quantity.unit for quantity in registry.describe(name).quantities
            }
    return units


def _label_events(run: Run) -> Iterator[EventLabel]:
    last_parameters: dict[str, Any] = {}
    for event, time in zip(run.events, run.times_of("event"), strict=True):
        if event.kind not in SHOWN_EVENTS:
            continue
        label, parameters = event.kind, event.data.get("parameters")
        if isinstance(parameters, dict):
            takes_over = event.kind != "parameters"
            changed = {
                name: value
                for name, value in parameters.items()
                if (value is not None if takes_over else value != last_parameters.get(name))
            }
            controller = str(event.data.get("controller", event.kind))
            settings = format_values(changed, registry.units(controller))
            label = f"{controller} {settings}".rstrip() if takes_over else settings or event.kind
            last_parameters = parameters
        elif event.kind == "mark":
            label = event.message
        elif event.kind == "fault":
            label = f"fault {event.data.get('code', '')}".strip()
        yield EventLabel(time, event.kind, text.line(label, MAX_TEXT_CHARS))


def _with_breaks(ticks: list[tuple[Tick, float]]) -> Iterator[tuple[Tick | None, float]]:
    """Yield ticks and their times, with None and the time of a break at each gap between two."""
    previous, before = None, 0.0
    for tick, time in ticks:
        if previous is not None and tick.seq != previous.seq + 1:
            yield None, before
        yield tick, time
        previous, before = tick, time


def _quantities(tick: Tick) -> dict[str, float]:
    return {**(tick.readings or {}), **(tick.quantities or {})}


def _swims(tick: Tick) -> bool:
    return tick.mode == "running"


def _title(run: Run) -> str:
    about = (run.about.get("subject", ""), run.about.get("note", ""))
    summary = run.summary
    lost = f", ticks lost: {summary.lost_ticks}" if summary.lost_ticks else ""
    what = "; ".join((run.name, *filter(None, about)))
    return f"{what} ({', '.join(summary.swim_ticks) or 'at rest'}{lost})"
