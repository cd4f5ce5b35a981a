"""One point of a sweep: the true thrust or speed of a simulated fish, or the thrust of a rig."""

import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from msgspec.structs import replace

from fishd.config import Config, Start
from fishd.control.reporting import Publisher
from fishd.controllers import registry
from fishd.controllers.base import amplitude_of
from fishd.core.errors import FishdError
from fishd.core.process.interruption import on_signal
from fishd.lab.measurement import measure
from fishd.lab.parallel import Stop, workers
from fishd.lab.session import Session, concerns_one_controller
from fishd.lab.simulation import Beats, VirtualRun
from fishd.lab.statistics import per_watt, student95
from fishd.lab.sweep.folder import SweepFolder
from fishd.lab.sweep.grid import Lengths, Point
from fishd.lab.sweep.results import Found, Result
from fishd.recording.writer import RunWriter
from fishd.virtual.plant.optimum import best_square_wave

SLOWEST = 0.4
"""A controller without a frequency is given the time of so slow a tail beat [Hz]."""


STOP = "stop"
"""A file of this name in the folder ends a sweep in simulation."""

Done = Callable[[Point, Found], None]


class Task(NamedTuple):
    """A point, and all that a worker needs to measure it."""

    point: Point
    config: Config
    lengths: Lengths
    stop: Stop


def simulated(task: Task) -> tuple[Found, bytes] | None:
    """What a simulated fish does at a point, and its recording; None where told to stop."""
    if task.stop.asked()():
        return None
    with tempfile.TemporaryDirectory() as folder:
        extra = {name: str(value) for name, value in task.point.columns().items()}
        path = Path(folder) / "point.mcap"
        with RunWriter(path, source="simulation", note=task.point.label(), extra=extra) as writer:
            result: Found

            def begun(run: VirtualRun) -> None:
                writer.describe(run.config, run.about())

            if task.config.robot == "swimmer":
                from fishd.lab.sweep.free_swimming import swim_freely

                asked = (task.point, task.config, task.lengths, writer)
                swum = swim_freely(*asked, begun, task.stop.asked())
                if swum is None:
                    return None
                result = swum
            else:
                result = swim(task.point, task.config, task.lengths, writer, begun)
        return result, path.read_bytes()


def swim(
    point: Point,
    config: Config,
    lengths: Lengths,
    publisher: Publisher,
    begun: Callable[[VirtualRun], None] = lambda run: None,
) -> Result:
    """The true thrust of a simulated fish at a point.

    The error is that of the mean over the beats, as they differ from one another: by noise that
    the controller answers, and by half beats that are no whole number of ticks.

    publisher: gets every tick, and every event
    begun: called before the first of them
    Raises `ParameterError` and `UnknownController`.
    """
    config = replace(config, start=Start())
    limits = replace(config.limits, virtual=True)
    controller = registry.create(point.controller, point.parameters, limits)
    asked = getattr(controller.parameters, "frequency", None)
    slowest = min(asked, SLOWEST) if isinstance(asked, float) and asked > 0.0 else SLOWEST
    settle = math.ceil(lengths.settle / config.tick)
    most = settle + math.ceil((lengths.periods + 2) / slowest / config.tick)
    beats = Beats()
    with VirtualRun(config, publisher) as run:
        begun(run)
        run.loop.set_controller(point.controller, controller)
        for index in range(most):
            angle = run.loop.applied
            window = run.tick()
            if index > settle:
                beats.add(angle, window)
            if beats.count >= lengths.periods or run.loop.supervisor.reason:
                break
        reason, fallback = run.loop.supervisor.reason, run.loop.active.fallback
    seconds = (index + 1) * config.tick
    if trouble := reason or fallback:
        return Result(seconds=seconds, trouble=trouble.message)
    means = beats.means()
    best = best_square_wave(config.plant, amplitude_of(controller.parameters, config.limits))
    error = None
    if beats.count > 1:
        error = student95(beats.count - 1) * means.thrust_deviation
    watts = means.power or math.nan
    return Result(
        thrust=means.thrust,
        error=error,
        beat_frequency=means.frequency,
        relative_thrust=means.thrust / best.thrust if best.thrust > 0.0 else None,
        fin_amplitude=means.fin_amplitude,
        power=means.power,
        thrust_per_watt=means.thrust / watts,
        thrust_per_watt_error=None if error is None else error / watts,
        seconds=seconds,
    )


def measure_point(point: Point, session: Session, seconds: float) -> Result:
    """Return the thrust measured at a point, without the drift of the sensor.

    There is trouble, and no thrust, where fishd refuses this controller, or it gives up.

    Raises as `fishd.lab.measurement.measure` what concerns the other points, too.
    """
    try:
        found = measure(session, point.controller, point.parameters, seconds)
    except FishdError as error:
        if not concerns_one_controller(error):
            raise
        return Result(trouble=str(error))
    gave, gave_error = per_watt(found.thrust, found.error, found.watts, found.watts_error)
    return Result(
        thrust=found.thrust,
        error=found.error,
        beat_frequency=found.frequency,
        power=found.watts,
        thrust_per_watt=gave,
        thrust_per_watt_error=gave_error,
        seconds=len(found.ticks) * session.tick,
    )


def swim_all(
    folder: SweepFolder,
    found: Sequence[tuple[Point, Config]],
    lengths: Lengths,
    done: Done,
    jobs: int | None = None,
    cluster: str | None = None,
) -> bool:
    """Swim simulated fish at the points that are missing; False where a signal ended that before.

    found: points, each with the configuration of its fish
    done: called with each point that ends
    jobs, cluster: as for `fishd.lab.parallel.workers`
    Raises `FishdError`; the points before are kept.
    """
    missing = [each for each in found if folder.key(each[0]) not in folder.results]
    is_whole = True
    with workers(folder.path / STOP, jobs, cluster) as crew, on_signal(crew.ask_to_stop):
        tasks = [Task(point, config, lengths, crew.stop) for point, config in missing]
        for index, outcome in crew.run(simulated, tasks):
            if outcome is None:
                is_whole = False
                continue
            point = missing[index][0]
            result, recording = outcome
            folder.keep(point, result, recording)
            done(point, result)
    return is_whole


def measure_all(
    folder: SweepFolder, found: Sequence[Point], session: Session, seconds: float, done: Done
) -> None:
    """Measure the missing points in a session, which the caller has entered.

    A point whose controller is refused, or gives up, has trouble, and the next one is measured.

    seconds: for each point [s]
    Raises `FishdError`; the points before are kept.
    """
    for point in found:
        if folder.key(point) in folder.results:
            continue
        extra = {name: str(value) for name, value in point.columns().items()}
        path = folder.recording_of(point)
        with session.recorded(path, point.label(), extra):
            result = measure_point(point, session, seconds)
        folder.keep(point, result, path)
        done(point, result)
