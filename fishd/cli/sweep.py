"""The verb that measures thrust over a grid of parameters, and proposes the best."""

import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec

from fishd.cli.config import set_option
from fishd.cli.lab_progress import Lines, showing
from fishd.cli.options import ControllerGroup, endpoint_option, json_option
from fishd.cli.output import counted, echo, print_json
from fishd.client import Fish
from fishd.config import Config, load
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError, NoDaemon
from fishd.core.signals import ControllerInfo

if TYPE_CHECKING:
    from fishd.lab.sweep.curves import Best
    from fishd.lab.sweep.folder import Begun, SweepFolder
    from fishd.lab.sweep.grid import Point
    from fishd.lab.sweep.measuring import Result

ON = click.option(
    "--on",
    type=click.Choice(["simulation", "robot"]),
    default="simulation",
    show_default=True,
    help="Fish simulated in virtual time, or that of the fishd that runs, real or not.",
)


def sweep_options(function: Any) -> Any:
    """The options of the verb itself."""
    for option in (
        json_option,
        endpoint_option,
        click.option(
            "--cluster", metavar="ADDRESS", help="In simulation: Dask scheduler that swims them."
        ),
        click.option(
            "--jobs", type=click.IntRange(min=1), help="In simulation: processes. [default: cores]"
        ),
        click.option(
            "--folder",
            type=click.Path(path_type=Path),
            help="Where table, recordings and picture go; a sweep that began in it is gone on "
            "with. [default: runs/sweep-DATE-TIME]",
        ),
        click.option(
            "--for",
            "seconds",
            type=click.FloatRange(min=0.0, min_open=True),
            help="On a robot: swimming and resting at each point [s]. [default: 30]",
        ),
        click.option(
            "--periods",
            type=click.IntRange(min=2),
            help="In simulation: tail beats judged at each point. [default: 20]",
        ),
        click.option(
            "--settle",
            type=click.FloatRange(min=0.0),
            help="In simulation: time before they are judged [s]. [default: 10]",
        ),
        click.option(
            "--vary",
            multiple=True,
            metavar="KEY=VALUES",
            help="In simulation: a key of the configuration with several values, such as "
            "plant.xi=0.05,0.6,1.2 or plant.omega0=8:14:2. Repeatable.",
        ),
        click.option(
            "--config",
            "file",
            type=click.Path(path_type=Path, readable=False),
            help="In simulation: YAML file of the fish; without it, the defaults.",
        ),
        set_option,
        ON,
    ):
        function = option(function)
    return function


@click.group(cls=ControllerGroup, options=sweep_options, remote=True, several=True)
def sweep() -> None:
    """Measure thrust over a grid of parameters: table, recordings, picture, and the best.

    CONTROLLERS is one, or several as square,sine,triangle. Each parameter takes a value, a list
    as 1,1.5,2, or a range as 0.4:4:0.2 (low:high:step); all combinations are measured. With
    --folder, a sweep that was interrupted goes on, and its grid may grow.
    """


@sweep.action
def _sweep(
    infos: list[ControllerInfo],
    parameters: dict[str, list[Any]],
    on: str,
    file: Path | None,
    overrides: tuple[str, ...],
    vary: tuple[str, ...],
    settle: float | None,
    periods: int | None,
    seconds: float | None,
    folder: Path | None,
    jobs: int | None,
    cluster: str | None,
    endpoint: str | None,
    as_json: bool,
) -> int:
    from fishd.lab.sweep import grid

    of_simulation = {
        "--config": file, "--set": overrides, "--vary": vary, "--settle": settle,
        "--periods": periods, "--jobs": jobs, "--cluster": cluster,
    }  # fmt: skip
    refuse_other(on, of_simulation, {"--for": seconds})
    names = [info.name for info in infos]
    takes = {info.name: [field.name for field in info.parameters] for info in infos}
    path = folder or Path("runs") / f"sweep-{datetime.now():%Y%m%d-%H%M%S}"
    if on == "robot":
        found = grid.points(names, parameters, takes)
        whole, kept = _on_robot(path, found, seconds or 30.0, endpoint)
        error_of = "the measurement"
    else:
        keys = dict(_varied(text) for text in vary)
        found = grid.points(names, parameters, takes, keys)
        lengths = {"settle": settle, "periods": periods}
        whole, kept = _in_simulation(path, found, file, overrides, lengths, jobs, cluster)
        error_of = "the mean over beats"
    units = {field.name: field.unit for info in infos for field in info.parameters}
    return _conclude(kept, found, units, error_of, whole, as_json)


def refuse_other(on: str, of_simulation: dict[str, Any], of_robot: dict[str, Any]) -> None:
    """Refuse options that mean nothing where the fish is; raises `UsageError`."""
    for name, value in (of_simulation if on == "robot" else of_robot).items():
        if value not in (None, ()):
            where = "is for --on simulation: a running fishd keeps its configuration"
            if name not in ("--config", "--set", "--vary"):
                where = f"is for --on {'simulation' if on == 'robot' else 'robot'}"
            raise click.UsageError(f"{name} {where}")


def _varied(text: str) -> tuple[str, list[str]]:
    from fishd.lab.sweep.grid import spread

    key, equals, values = text.partition("=")
    if not (equals and key.strip()):
        raise click.UsageError(f"--vary {text}: write KEY=VALUES, such as plant.xi=0.05,0.6,1.2")
    return key.strip(), spread(values)


def _in_simulation(
    path: Path,
    found: "list[Point]",
    file: Path | None,
    overrides: tuple[str, ...],
    given: dict[str, Any],
    jobs: int | None,
    cluster: str | None,
) -> "tuple[bool, SweepFolder]":
    from fishd.lab.sweep import grid, running
    from fishd.lab.sweep.folder import Begun
    from fishd.lab.sweep.measuring import Lengths

    lengths = Lengths(**{name: value for name, value in given.items() if value is not None})
    fish: dict[tuple[tuple[str, Any], ...], Config] = {}
    pairs = []
    for point in found:
        changed = tuple(point.keys.items())
        if changed not in fish:
            fish[changed] = load(file, (*overrides, *(f"{k}={v}" for k, v in changed)))
        grid.check(point, fish[changed])
        pairs.append((point, fish[changed]))
    config = msgspec.to_builtins(load(file, overrides))
    begun = Begun("simulation", config, msgspec.to_builtins(lengths))
    with _opened(path, begun, found) as folder, _showing(folder, found, "points", 1.0) as count:
        whole = running.in_simulation(folder, pairs, lengths, count.done, jobs, cluster)
    return whole, folder


def _on_robot(
    path: Path, found: "list[Point]", seconds: float, endpoint: str | None
) -> "tuple[bool, SweepFolder]":
    from fishd.lab.measurement import plan
    from fishd.lab.rig import Disturbed, LiveRig
    from fishd.lab.sweep import running
    from fishd.lab.sweep.folder import Begun

    for point in found:
        plan(seconds, point.parameters)  # which says that it is too short, before anything moves
    with Fish(endpoint) as fish:
        unit = fish.status().force_unit
        begun = Begun("robot", fish.config(), {"seconds": seconds}, unit)
        with _opened(path, begun, found) as folder, _showing(folder, found, "s", seconds) as count:
            try:
                whole = running.on_robot(
                    folder, found, LiveRig(fish), seconds, count.done, count.at
                )
            except (Disturbed, NoDaemon) as error:
                raise FishdError(f"{error}; to go on: {_again(path)}") from None
    return whole, folder


@contextmanager
def _opened(path: Path, begun: "Begun", found: "list[Point]") -> "Iterator[SweepFolder]":
    from fishd.lab.sweep.folder import SweepFolder, owned

    columns = dict.fromkeys(name for point in found for name in point.columns())
    with owned(path):
        folder = SweepFolder(path, begun, list(columns))
        yield folder
        folder.sort(found)


class _Count:
    """Tells what is done, point by point."""

    def __init__(self, show: Lines, before: int, each: float, unit: str) -> None:
        self._show = show
        self._finished = before
        self._each = each
        self._unit = unit

    def done(self, point: "Point", result: "Result") -> None:
        """A point is done."""
        self._finished += 1
        self._show.done(
            f"{point.label()}: {_figures(result, self._unit)}", self._finished * self._each
        )

    def at(self, seconds: float) -> None:
        """The present point has taken so long [s]."""
        self._show.at(self._finished * self._each + seconds)


@contextmanager
def _showing(
    folder: "SweepFolder", found: "list[Point]", unit: str, each: float
) -> "Iterator[_Count]":
    """each: what a point counts, in `unit`."""
    before = sum(folder.key(point) in folder.results for point in found)
    there = f", {before} of them there already" if before else ""
    echo(f"{folder.path}: {counted(len(found), 'point')}{there}")
    with showing(len(found) * each, unit) as show:
        show.at(before * each)
        yield _Count(show, before, each, folder.begun.force_unit)


def _figures(result: "Result", unit: str) -> str:
    if result.thrust is None:
        return f"no thrust: {result.trouble}"
    error = "" if result.error is None else f" ± {result.error * 1e3:.2f}"
    beats = f", {result.beat_frequency:.2f} Hz" if result.beat_frequency else ""
    return f"{result.thrust * 1e3:.2f}{error} m{unit}{beats}"


def _conclude(
    folder: "SweepFolder",
    found: "list[Point]",
    units: dict[str, str],
    error_of: str,
    whole: bool,
    as_json: bool,
) -> int:
    """Draw what there is, and say what is best; the exit status."""
    from fishd.lab.sweep import curves, figure

    drawn = curves.curves(folder, found)
    unit = folder.begun.force_unit
    bests = [(curve, best) for curve in drawn if (best := curves.best(curve))]
    pictures = []
    if bests:
        stem = folder.path / "thrust"
        pictures = figure.draw(stem, drawn, units, error_of=error_of, force_unit=unit)
    if as_json:
        print_json([best for _, best in bests])
    else:
        for curve, best in bests:
            echo(f"{curve.label}: {_proposal(best, units.get(best.over, ''), unit)}")
        echo(f"table: {folder.path / 'points.csv'}")
        if pictures:
            echo(f"picture: {pictures[0]}, and as {pictures[1].suffix[1:].upper()}")
    if not whole:
        done = sum(folder.key(point) in folder.results for point in found)
        echo(
            f"fishctl: stopped after {done} of {counted(len(found), 'point')}; to go on: "
            f"{_again(folder.path)}",
            err=True,
        )
        return INTERRUPTED
    troubles = [point for point in found if folder.results[folder.key(point)].trouble]
    return 1 if troubles else 0


def _proposal(best: "Best", unit: str, force_unit: str) -> str:
    symbol = "" if unit in ("", "1") else f" {unit}"
    error = "" if best.error is None else f" ± {best.error * 1e3:.2f}"
    thrust = f"{best.thrust * 1e3:.2f}{error} m{force_unit}"
    if best.at_edge:
        return (
            f"best measured at {best.over} {best.x:g}{symbol}, {thrust}: at the edge of the grid, "
            "so the best may lie beyond it"
        )
    if best.x_low is None or best.x_high is None:
        return f"best measured at {best.over} {best.x:.4g}{symbol}: {thrust}"
    interval = f"[{best.x_low:.4g}, {best.x_high:.4g}]"
    return f"best {best.over} {best.x:.4g}{symbol} {interval}: {thrust}"


def _again(folder: Path) -> str:
    """The command line that goes on with a sweep."""
    words = sys.argv[1:]
    if not any(word == "--folder" or word.startswith("--folder=") for word in words):
        words = [*words, "--folder", str(folder)]
    return shlex.join(["fishctl", *words])
