"""The speed of a free swimmer, steady or soon after its start, measured over whole beats."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from fishd.config import Config, Start
from fishd.controllers import registry
from fishd.core.beats import Reversals
from fishd.core.errors import ConfigError
from fishd.core.signals import Publisher
from fishd.lab.simulation import VirtualRun
from fishd.lab.statistics import student95
from fishd.lab.sweep.grid import Lengths, Point
from fishd.lab.sweep.results import SpeedResult
from fishd.lab.swimmer.refinement import find_grid_error
from fishd.virtual.swimmer.track import Track

if TYPE_CHECKING:
    from fishd.virtual.swimmer.robot import Swimmer

Array = NDArray[np.float64]
MAX_SWIM_S = 24.0
"""Time after which the speed is measured even if it still changes [s]."""
MIN_MEASURED_S = 8.0
"""Shortest duration of the beats that are measured, for waves of high frequency [s]."""
STEADY_FRACTION, SCATTER_FRACTION = 0.02, 0.05
"""Fractions of the speed, or of 0.1 body lengths per second if that is more.

The speed is steady if the means of its two halves differ by less than the first fraction. A
difference up to the second fraction is allowed if it lies within its 95 % confidence interval.
"""
FROM_REST = Lengths(settle=0.0, periods=3)
"""Lengths of a swim from rest: its beats 2 to 4 are measured."""
_STOP_CHECK_TICKS = 50


def find_swimmer(run: VirtualRun) -> "Swimmer":
    """Return the free swimmer of a run; raise `ConfigError` if its fish is of another kind."""
    from fishd.virtual.swimmer.robot import Swimmer  # imports numba

    if not isinstance(run.fish, Swimmer):
        raise ConfigError(
            f"robot: {run.config.robot} does not hang from a force sensor, so it has no thrust to "
            "measure, and its speed is measured only with robot: swimmer"
        )
    return run.fish


def swim_freely(
    point: Point,
    config: Config,
    lengths: Lengths,
    publisher: Publisher | None,
    on_start: Callable[[VirtualRun], None] = lambda run: None,
    stop: Callable[[], bool] = lambda: False,
) -> SpeedResult | None:
    """Return the steady speed of a free swimmer at a point, over whole beats.

    The fish swims until the speeds of at least `lengths.periods` beats and `MIN_MEASURED_S` seconds
    show no trend. After `MAX_SWIM_S` seconds the later half is measured, or `lengths.periods` beats
    if the half has fewer, and `settled_time` is None.

    lengths: with `FROM_REST`, the beats after the first one are measured, steady or not
    publisher: receives every tick and every event; None to create no messages
    on_start: called before the first tick
    stop: called regularly; if it returns True, the swim ends and None is returned
    Raises `ParameterError` and `UnknownController`.
    """
    config = replace(config, start=Start())
    controller = registry.create(
        point.controller, point.parameters, replace(config.limits, virtual=True)
    )
    values = msgspec.structs.asdict(controller.parameters)
    share = find_grid_error(config, point.controller, values)  # raises before the swim
    track = Track()
    beat_starts: list[int] = []
    with VirtualRun(config, publisher) as run:
        fish = find_swimmer(run)
        on_start(run)
        track.begin(fish)
        run.loop.set_controller(point.controller, controller)
        reversals = Reversals()
        first: int | None = None
        while first is None and not _is_long_enough(track, beat_starts, lengths, config.tick):
            instruction_angle = run.loop.instruction_angle
            run.tick()
            problem = fish.trouble or run.loop.supervisor.reason or run.loop.active.fallback
            if problem:
                message = getattr(problem, "message", str(problem))
                return SpeedResult(seconds=len(track) * config.tick, failure=message)
            track.add(fish, instruction_angle)
            if reversals.add(instruction_angle) > 0 and len(track) * config.tick > lengths.settle:
                beat_starts.append(len(track) - 1)
                first = _find_first_row(track, beat_starts, lengths, config)
            if len(track) % _STOP_CHECK_TICKS == 0 and stop():
                return None
    result = _make_result(track, beat_starts, first, lengths, config)
    error = None if share is None or result.speed is None else share * abs(result.speed)
    return replace(result, grid_error=error)


def _is_long_enough(track: Track, beat_starts: list[int], lengths: Lengths, tick: float) -> bool:
    """Return whether the swim ends; a slow wave gets time for its beats, a still fin does not."""
    time, longest = len(track) * tick, max(MAX_SWIM_S, 4.0 * lengths.settle)
    waiting = 0 < len(beat_starts) <= lengths.periods and time < 4.0 * longest
    return time >= longest and not waiting


def _find_first_row(
    track: Track, beat_starts: list[int], lengths: Lengths, config: Config
) -> int | None:
    """Return the row of the first measured beat; None while more beats are needed."""
    if len(beat_starts) - 1 < lengths.periods:
        return None
    if lengths is FROM_REST:
        return beat_starts[0]
    time, x = _read_positions(track, beat_starts)
    beat = find_first_measured(time, x)
    if len(beat_starts) - 1 - beat < lengths.periods:
        return None
    is_settled = is_steady(time[beat:], x[beat:], config.swimmer.body.length)
    return beat_starts[beat] if is_settled else None


def _read_positions(track: Track, beat_starts: list[int]) -> tuple[Array, Array]:
    """Return the times [s] and positions [m] at which beats begin: the ends of the ticks before."""
    columns = track.columns()
    rows = np.array(beat_starts) - 1
    return columns["time"][rows], columns["x"][rows]


def _make_result(
    track: Track, beat_starts: list[int], first: int | None, lengths: Lengths, config: Config
) -> SpeedResult:
    from fishd.virtual.swimmer.gait import gait  # imports numba

    columns = track.columns()
    row = first
    if row is None:
        count = len(beat_starts) - 1
        beat = max(0, min(count // 2, count - lengths.periods))
        row = beat_starts[beat] if beat_starts else len(track) // 2
    measured = gait({name: values[row - 1 :] for name, values in columns.items()}, config.swimmer)
    return SpeedResult(
        speed=measured.speed,
        speed_ci95=measured.speed_ci95,
        beat_frequency=measured.frequency,
        beats=measured.beats,
        settled_time=None if first is None else float(columns["time"][first - 1]),
        tail_width=measured.tail_width,
        muscle_power=measured.muscle_power,
        cost_of_transport=measured.cost_of_transport,
        strouhal=measured.strouhal,
        froude_efficiency=measured.froude_efficiency,
        seconds=len(track) * config.tick,
    )


def find_first_measured(beat_starts: Array, x: Array) -> int:
    """Return the index of the first measured beat.

    beat_starts: times at which beats begin, and the last one ends, shape (beats + 1,) [s]
    x: positions of the fish at these times, shape (beats + 1,) [m]

    The number of dropped beats is the one that minimises the standard error of the mean of the
    others, but at most half of them (the rule MSER of White, "An effective truncation heuristic for
    bias reduction in simulation output", Simulation 69, 1997, doi:10.1177/003754979706900601).
    """
    speeds = -np.diff(x) / np.diff(beat_starts)
    count = len(speeds)
    errors = [speeds[first:].std() / math.sqrt(count - first) for first in range(count // 2 + 1)]
    return int(np.argmin(errors)) if errors else 0


def is_steady(beat_starts: Array, x: Array, length: float) -> bool:
    """Return whether the mean speeds over the two halves of these beats agree.

    beat_starts, x: as for `find_first_measured`; length: body length of the fish [m]
    """
    count = len(beat_starts) - 1
    if count < 2 or beat_starts[-1] - beat_starts[0] < MIN_MEASURED_S:
        return False
    speeds = -np.diff(x) / np.diff(beat_starts)
    halves = speeds[: count // 2], speeds[count - count // 2 :]
    difference = abs(float(halves[0].mean() - halves[1].mean()))
    scale = max(abs(float(speeds.mean())), 0.1 * length)
    tolerance = STEADY_FRACTION * scale
    if count >= 4:
        variance = sum(half.var(ddof=1) / len(half) for half in halves)
        interval = student95(count // 2 * 2 - 2) * math.sqrt(variance)
        tolerance = max(tolerance, min(interval, SCATTER_FRACTION * scale))
    return difference <= tolerance
