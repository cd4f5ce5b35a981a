"""Measurement of a sweep's points: true thrust or speed of a simulated fish, thrust of a rig."""

import math
import tempfile
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from msgspec.structs import replace

from fishd.config import Config, Start
from fishd.controllers import registry
from fishd.controllers.base import amplitude_of
from fishd.core.errors import FishdError
from fishd.core.process.interruption import on_signal
from fishd.core.signals import Publisher
from fishd.lab.measurement import measure
from fishd.lab.parallel import workers
from fishd.lab.session import Session, concerns_one_controller
from fishd.lab.simulation import Beats, VirtualRun
from fishd.lab.statistics import student95
from fishd.lab.sweep.grid import Lengths, Point
from fishd.lab.sweep.results import PointResult, Result, SweepFolder
from fishd.lab.swimmer.speed import swim_freely
from fishd.lab.workers import Stop
from fishd.recording.writer import RunWriter
from fishd.virtual.plant.optimum import best_square_wave

SLOWEST_BEAT_HZ = 0.4
"""Tail-beat frequency that limits the duration for a controller without a frequency [Hz]."""

STOP_FILE = "stop"
"""Name of the file in the folder that ends a sweep in simulation."""

_STOP_CHECK_TICKS = 50


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
                writer.describe(run.config, run.about(), run.readings)

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
    is_known = config.kind.is_of_plant() and best.thrust > 0.0
    error = None
    if beats.count > 1:
        error = student95(beats.count - 1) * means.thrust_deviation
    watts = means.power or math.nan
    return Result(
        thrust=means.thrust,
        thrust_ci95=error,
        beat_frequency=means.frequency,
        relative_thrust=means.thrust / best.thrust if is_known else None,
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
    return Result(
        thrust=measured.thrust,
        thrust_ci95=measured.thrust_ci95,
        beat_frequency=measured.frequency,
        fin_angle_max=measured.fin_angle_max,
        fin_angle_max_ci95=measured.fin_angle_max_ci95,
        power=measured.power,
        thrust_per_watt=measured.thrust_per_watt,
        thrust_per_watt_ci95=measured.thrust_per_watt_ci95,
        seconds=measured.seconds,
    )


def swim_all(
    folder: SweepFolder,
    points: Sequence[tuple[Point, Config]],
    lengths: Lengths,
    jobs: int | None = None,
    cluster: str | None = None,
) -> Generator[tuple[Point, PointResult], None, None]:
    """Swim simulated fish at the missing points; yield each with its result, which is stored.

    A signal ends this early.

    points: the points, each with the configuration of its fish
    jobs, cluster: as for `fishd.lab.parallel.workers`
    Raises `FishdError`; the results of finished points are kept.
    """
    missing = [pair for pair in points if folder.key(pair[0]) not in folder.results]
    if not missing:
        return
    with workers(folder.path / STOP_FILE, jobs, cluster) as pool, on_signal(pool.ask_to_stop):
        tasks = [Task(point, config, lengths, pool.stop) for point, config in missing]
        for index, outcome in pool.run(simulate_point, tasks):
            if outcome is not None:
                folder.add_result(missing[index][0], *outcome)
                yield missing[index][0], outcome[0]


def measure_all(
    folder: SweepFolder, points: Sequence[Point], session: Session, seconds: float
) -> Iterator[tuple[Point, PointResult]]:
    """Measure the missing points in a session that the caller has entered; yield each result.

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
        yield point, result
