"""Measurement of a sweep's points: true thrust or speed of a simulated fish, thrust of a rig."""

import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from fishd.config import Config, Start
from fishd.controllers import registry
from fishd.controllers.base import amplitude_of
from fishd.core.beats import Reversals
from fishd.core.errors import FishdError
from fishd.core.process.interruption import on_signal
from fishd.core.signals import Publisher
from fishd.lab.measurement import measure
from fishd.lab.parallel import workers
from fishd.lab.session import Session, concerns_one_controller
from fishd.lab.simulation import Beats, VirtualRun
from fishd.lab.statistics import per_watt, student95
from fishd.lab.sweep.grid import Lengths, Point
from fishd.lab.sweep.results import PointResult, Result, SpeedResult, SweepFolder
from fishd.lab.swimmer.refinement import find_grid_error
from fishd.lab.workers import Stop
from fishd.recording.writer import RunWriter
from fishd.virtual.plant.optimum import best_square_wave
from fishd.virtual.swimmer.track import Track

SLOWEST_BEAT_HZ = 0.4
"""Tail-beat frequency that limits the duration for a controller without a frequency [Hz]."""

STOP_FILE = "stop"
"""Name of the file in the folder that ends a sweep in simulation."""

PointCallback = Callable[[Point, PointResult], None]
Array = NDArray[np.float64]
MAX_SWIM_S = 24.0
"""Time after which the speed is measured even if it still changes [s]."""
_STOP_CHECK_TICKS = 50
MIN_MEASURED_S = 8.0
"""Shortest duration of the beats that are measured, for waves of high frequency [s]."""
STEADY_FRACTION, SCATTER_FRACTION = 0.02, 0.05
"""Fractions of the speed, or of 0.1 body lengths per second if that is more.

The speed is steady if the means of its two halves differ by less than the first fraction. A
difference up to the second fraction is allowed if it lies within its 95 % confidence interval.
"""


class Task(NamedTuple):
    """A point, and everything that a worker needs to measure it."""

    point: Point
    config: Config
    lengths: Lengths
    stop: Stop


def simulate_point(task: Task) -> tuple[PointResult, bytes] | None:
    """Return the result and the recording of a simulated fish at a point; None if stopped."""
    if task.stop.make_check()():
        return None
    try:
        temporary = tempfile.TemporaryDirectory()
    except OSError:
        raise FishdError(
            "no folder of temporary files can be written: free some space in /tmp, or set TMPDIR"
        ) from None
    with temporary as folder:
        extra = {name: str(value) for name, value in task.point.columns().items()}
        path = Path(folder) / "point.mcap"
        with RunWriter(
            path, source="simulation", note=task.point.label(), extra=extra, is_temporary=True
        ) as writer:
            result: PointResult

            def describe_run(run: VirtualRun) -> None:
                writer.describe(run.config, run.about())

            arguments = (task.point, task.config, task.lengths, writer, describe_run)
            measure = swim if task.config.kind.is_tethered else swim_freely
            measured = measure(*arguments, task.stop.make_check())
            if measured is None:
                return None
            result = measured
        return result, path.read_bytes()


def swim(
    point: Point,
    config: Config,
    lengths: Lengths,
    publisher: Publisher | None,
    on_start: Callable[[VirtualRun], None] = lambda run: None,
    stop: Callable[[], bool] = lambda: False,
) -> Result | None:
    """Return the true thrust of a simulated fish at a point; None if stopped.

    The error is that of the mean over the beats. Beats differ because the controller reacts to
    noise, and because half beats are not always whole ticks.

    publisher: receives every tick and every event; None to create no messages
    on_start: called before the first tick
    stop: called once in some ticks; returns whether to stop
    Raises `ParameterError` and `UnknownController`.
    """
    config = replace(config, start=Start())
    limits = replace(config.limits, virtual=True)
    controller = registry.create(point.controller, point.parameters, limits)
    frequency = getattr(controller.parameters, "frequency", None)
    lowest_frequency = (
        min(frequency, SLOWEST_BEAT_HZ)
        if isinstance(frequency, float) and frequency > 0.0
        else SLOWEST_BEAT_HZ
    )
    settle = math.ceil(lengths.settle / config.tick)
    max_ticks = settle + math.ceil((lengths.periods + 2) / lowest_frequency / config.tick)
    beats = Beats()
    with VirtualRun(config, publisher) as run:
        on_start(run)
        run.loop.set_controller(point.controller, controller)
        for index in range(max_ticks):
            angle = run.loop.instruction_angle
            window = run.tick()
            if index > settle:
                beats.add(angle, window)
            if beats.count >= lengths.periods or run.loop.supervisor.reason:
                break
            if index % _STOP_CHECK_TICKS == 0 and stop():
                return None
        reason, fallback = run.loop.supervisor.reason, run.loop.active.fallback
    seconds = (index + 1) * config.tick
    if trouble := reason or fallback:
        return Result(seconds=seconds, failure=trouble.message)
    means = beats.means()
    best = best_square_wave(config.plant, amplitude_of(controller.parameters, config.limits))
    error = None
    if beats.count > 1:
        error = student95(beats.count - 1) * means.thrust_deviation
    watts = means.power or math.nan
    return Result(
        thrust=means.thrust,
        thrust_ci95=error,
        beat_frequency=means.frequency,
        relative_thrust=means.thrust / best.thrust if best.thrust > 0.0 else None,
        fin_amplitude=means.fin_amplitude,
        power=means.power,
        thrust_per_watt=means.thrust / watts,
        thrust_per_watt_ci95=None if error is None else error / watts,
        seconds=seconds,
    )


def measure_point(point: Point, session: Session, seconds: float) -> Result:
    """Return the thrust measured at a point, without the drift of the sensor.

    The result has `failure` and no thrust if fishd refuses the controller, or if the controller
    gives up. Errors of `fishd.lab.measurement.measure` that concern other points, too, are raised.
    """
    try:
        measured = measure(session, point.controller, point.parameters, seconds)
    except FishdError as error:
        if not concerns_one_controller(error):
            raise
        return Result(failure=str(error))
    per_watt_value, per_watt_ci95 = per_watt(
        measured.thrust, measured.thrust_ci95, measured.watts, measured.watts_ci95
    )
    return Result(
        thrust=measured.thrust,
        thrust_ci95=measured.thrust_ci95,
        beat_frequency=measured.frequency,
        power=measured.watts,
        thrust_per_watt=per_watt_value,
        thrust_per_watt_ci95=per_watt_ci95,
        seconds=len(measured.ticks) * session.tick,
    )


def swim_all(
    folder: SweepFolder,
    points: Sequence[tuple[Point, Config]],
    lengths: Lengths,
    done: PointCallback,
    jobs: int | None = None,
    cluster: str | None = None,
) -> bool:
    """Swim simulated fish at the missing points; return False if a signal ended the sweep early.

    points: the points, each with the configuration of its fish
    done: called with each finished point
    jobs, cluster: as for `fishd.lab.parallel.workers`
    Raises `FishdError`; the results of finished points are kept.
    """
    missing = [pair for pair in points if folder.key(pair[0]) not in folder.results]
    if not missing:
        return True
    with workers(folder.path / STOP_FILE, jobs, cluster) as pool, on_signal(pool.ask_to_stop):
        tasks = [Task(point, config, lengths, pool.stop) for point, config in missing]
        for index, outcome in pool.run(simulate_point, tasks):
            if outcome is None:
                continue
            point = missing[index][0]
            result, recording = outcome
            folder.add_result(point, result, recording)
            done(point, result)
    return all(folder.key(point) in folder.results for point, _ in missing)


def measure_all(
    folder: SweepFolder,
    points: Sequence[Point],
    session: Session,
    seconds: float,
    done: PointCallback,
) -> None:
    """Measure the missing points in a session that the caller has entered.

    If a controller is refused or gives up, its point gets `failure` and the next one is measured.

    seconds: duration of each point [s]
    Raises `FishdError`; the results of finished points are kept.
    """
    for point in points:
        if folder.key(point) in folder.results:
            continue
        extra = {name: str(value) for name, value in point.columns().items()}
        path = folder.recording_path(point)
        with session.recorded(path, point.label(), extra):
            result = measure_point(point, session, seconds)
        folder.add_result(point, result, path)
        done(point, result)


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
    grid_error = find_grid_error(config, point.controller, values)  # raises before the swim
    track = Track()
    beat_starts: list[int] = []
    with VirtualRun(config, publisher) as run:
        fish = run.swimmer
        assert fish
        on_start(run)
        track.begin(fish)
        run.loop.set_controller(point.controller, controller)
        reversals = Reversals()
        first: int | None = None
        while first is None and not _is_long_enough(track, beat_starts, lengths, config.tick):
            command = run.loop.instruction_angle
            run.tick()
            problem = fish.trouble or run.loop.supervisor.reason or run.loop.active.fallback
            if problem:
                message = getattr(problem, "message", str(problem))
                return SpeedResult(seconds=len(track) * config.tick, failure=message)
            track.add(fish, command)
            if reversals.add(command) > 0 and len(track) * config.tick > lengths.settle:
                beat_starts.append(len(track) - 1)
                first = _find_first_row(track, beat_starts, lengths, config)
            if len(track) % _STOP_CHECK_TICKS == 0 and stop():
                return None
    result = _make_result(track, beat_starts, first, lengths, config)
    return replace(result, grid_error=grid_error)


def _is_long_enough(track: Track, beat_starts: list[int], lengths: Lengths, tick: float) -> bool:
    """Return whether the swim ends; a slow wave gets time for its beats, a still fin does not."""
    time, longest = len(track) * tick, max(MAX_SWIM_S, 4.0 * lengths.settle)
    waiting = 0 < len(beat_starts) <= lengths.periods and time < 4.0 * longest
    return time >= longest and not waiting


def _find_first_row(
    track: Track, beat_starts: list[int], lengths: Lengths, config: Config
) -> int | None:
    """Return the row of the first measured beat; None while the speed changes."""
    if len(beat_starts) - 1 < lengths.periods:
        return None
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
