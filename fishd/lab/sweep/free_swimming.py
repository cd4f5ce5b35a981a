"""One point of a sweep with a fish that swims freely: its speed once that is settled."""

import math
from collections.abc import Callable

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from fishd.config import Config, Start
from fishd.control.reporting import Publisher
from fishd.controllers import registry
from fishd.core.beats import Reversals
from fishd.lab.simulation import VirtualRun
from fishd.lab.statistics import student95
from fishd.lab.sweep.grid import Lengths, Point
from fishd.lab.sweep.results import SpeedResult
from fishd.virtual.swimmer.gait import gait
from fishd.virtual.swimmer.track import Track

Array = NDArray[np.float64]
LONGEST = 24.0
"""A fish whose speed still changes is judged all the same after so long [s]."""
_ASK_EVERY = 50
LEAST_TIME = 8.0
"""The beats that are judged take as long at least: a fast wave has many in a moment [s]."""
STEADY, SCATTERING = 0.02, 0.05
"""The speed is steady where its two halves agree to the first share of it, or of a tenth of a
length a second; or to the second one, and within the 95 % interval of their difference."""


def swim_freely(
    point: Point,
    config: Config,
    lengths: Lengths,
    publisher: Publisher,
    begun: Callable[[VirtualRun], None] = lambda run: None,
    stop: Callable[[], bool] = lambda: False,
) -> SpeedResult | None:
    """The speed of a free swimmer at a point, over whole beats once it is settled.

    It swims until the speeds of `lengths.periods` beats, and of the seconds that `settling` names,
    show no trend, or for `LONGEST` seconds: then the later half is judged, or as many beats as that
    where it has fewer, and `settled` is None.

    publisher: gets every tick, and every event
    begun: called before the first of them
    stop: asked now and then whether to stop, and give None
    Raises `ParameterError` and `UnknownController`.
    """
    config = replace(config, start=Start())
    controller = registry.create(
        point.controller, point.parameters, replace(config.limits, virtual=True)
    )
    track = Track()
    begins: list[int] = []
    with VirtualRun(config, publisher) as run:
        fish = run.swimmer
        assert fish
        begun(run)
        track.begin(fish)
        run.loop.set_controller(point.controller, controller)
        reversals = Reversals()
        first: int | None = None
        while first is None and not _is_long_enough(track, begins, lengths, config.tick):
            command = run.loop.applied
            run.tick()
            trouble = fish.trouble or run.loop.supervisor.reason or run.loop.active.fallback
            if trouble:
                message = getattr(trouble, "message", str(trouble))
                return SpeedResult(seconds=len(track) * config.tick, trouble=message)
            track.add(fish, command)
            if reversals.add(command) > 0 and len(track) * config.tick > lengths.settle:
                begins.append(len(track) - 1)
                first = _settled(track, begins, lengths, config)
            if len(track) % _ASK_EVERY == 0 and stop():
                return None
    return _result(track, begins, first, lengths, config)


def _is_long_enough(track: Track, begins: list[int], lengths: Lengths, tick: float) -> bool:
    """A slow wave gets the time for its beats; what does not beat at all is not waited for."""
    time, longest = len(track) * tick, max(LONGEST, 4.0 * lengths.settle)
    waiting = 0 < len(begins) <= lengths.periods and time < 4.0 * longest
    return time >= longest and not waiting


def _settled(track: Track, begins: list[int], lengths: Lengths, config: Config) -> int | None:
    """The row of the first beat that is judged; None while the speed changes."""
    if len(begins) - 1 < lengths.periods:
        return None
    time, x = _at(track, begins)
    beat = judged_from(time, x)
    if len(begins) - 1 - beat < lengths.periods:
        return None
    steady = is_steady(time[beat:], x[beat:], config.swimmer.body.length)
    return begins[beat] if steady else None


def _at(track: Track, begins: list[int]) -> tuple[Array, Array]:
    """Time and place where beats begin: at the end of the tick before."""
    columns = track.columns()
    rows = np.array(begins) - 1
    return columns["time"][rows], columns["x"][rows]


def _result(
    track: Track, begins: list[int], first: int | None, lengths: Lengths, config: Config
) -> SpeedResult:
    columns = track.columns()
    row = first
    if row is None:
        count = len(begins) - 1
        beat = max(0, min(count // 2, count - lengths.periods))
        row = begins[beat] if begins else len(track) // 2
    found = gait({name: values[row - 1 :] for name, values in columns.items()}, config.swimmer)
    return SpeedResult(
        speed=found.speed,
        error=found.speed_error,
        beat_frequency=found.frequency,
        beats=found.beats,
        settled=None if first is None else float(columns["time"][first - 1]),
        tail_width=found.tail_width,
        muscle_power=found.muscle_power,
        cost_of_transport=found.cost_of_transport,
        strouhal=found.strouhal,
        froude_efficiency=found.froude_efficiency,
        seconds=len(track) * config.tick,
    )


def judged_from(begins: Array, x: Array) -> int:
    """The number of the first beat that is judged.

    begins: when beats begin, and the last one ends, shape (beats + 1,) [s]
    x: where the fish is then, shape (beats + 1,) [m]

    So many beats are dropped that the standard error of the mean of the others is the smallest, but
    not more than half of them (the rule MSER of White, "An effective truncation heuristic for bias
    reduction in simulation output", Simulation 69, 1997, doi:10.1177/003754979706900601).
    """
    speeds = -np.diff(x) / np.diff(begins)
    count = len(speeds)
    errors = [speeds[first:].std() / math.sqrt(count - first) for first in range(count // 2 + 1)]
    return int(np.argmin(errors)) if errors else 0


def is_steady(begins: Array, x: Array, length: float) -> bool:
    """Whether the mean speeds over the two halves of these beats agree.

    begins, x: as for `judged_from`; length: of the fish [m]
    """
    count = len(begins) - 1
    if count < 2 or begins[-1] - begins[0] < LEAST_TIME:
        return False
    speeds = -np.diff(x) / np.diff(begins)
    halves = speeds[: count // 2], speeds[count - count // 2 :]
    apart = abs(float(halves[0].mean() - halves[1].mean()))
    scale = max(abs(float(speeds.mean())), 0.1 * length)
    allowed = STEADY * scale
    if count >= 4:
        variance = sum(half.var(ddof=1) / len(half) for half in halves)
        interval = student95(count // 2 * 2 - 2) * math.sqrt(variance)
        allowed = max(allowed, min(interval, SCATTERING * scale))
    return apart <= allowed
