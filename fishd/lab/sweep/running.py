"""Runs a sweep: measures every point that its folder does not have yet."""

from collections.abc import Callable, Sequence

from fishd.config import Config
from fishd.core.process.interruption import interrupted_once, on_signal
from fishd.lab.parallel import workers
from fishd.lab.rig import Rig
from fishd.lab.rig_recording import recorded
from fishd.lab.sweep.folder import SweepFolder
from fishd.lab.sweep.grid import Lengths, Point
from fishd.lab.sweep.measuring import Task, on_rig, simulated
from fishd.lab.sweep.results import Found

STOP = "stop"
"""A file of this name in the folder ends a sweep in simulation."""

Done = Callable[[Point, Found], None]


def in_simulation(
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


def on_robot(
    folder: SweepFolder,
    found: Sequence[Point],
    rig: Rig,
    seconds: float,
    done: Done,
    progress: Callable[[float], None] = lambda seconds: None,
) -> bool:
    """Measure on a rig what is missing; False where a signal ended that before.

    A point whose controller is refused, or gives up, has trouble, and the next one is measured.
    The fish rests afterwards, whatever ends it.

    seconds: for each point [s]
    progress: called with the time that the present point has taken so far [s]
    Raises `FishdError`; the points before are kept.
    """
    try:
        with interrupted_once(), rig:
            for point in found:
                if folder.key(point) in folder.results:
                    continue
                extra = {name: str(value) for name, value in point.columns().items()}
                path = folder.recording_of(point)
                with recorded(rig, path, point.label(), extra):
                    result = on_rig(point, rig, seconds, progress)
                folder.keep(point, result, path)
                done(point, result)
    except KeyboardInterrupt:
        return False
    return True
