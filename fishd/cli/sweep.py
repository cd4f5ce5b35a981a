"""The verb that measures thrust, or speed, over a grid of parameters, and proposes the best."""

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec
from msgspec.structs import replace

from fishd.cli.config import set_option
from fishd.cli.lease_options import take_option, verb_lease
from fishd.cli.options import ControllerGroup, FiniteRange, endpoint_option, json_option
from fishd.cli.sweep_output import again, conclude, telling
from fishd.client import Fish
from fishd.config import Config, check_tethered, load
from fishd.controllers.base import Limits
from fishd.core.errors import ConfigError, FishdError, NoDaemon
from fishd.core.signals import ControllerInfo

if TYPE_CHECKING:
    from fishd.lab.sweep.folder import Begun, SweepFolder
    from fishd.lab.sweep.grid import Point

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
        take_option,
        click.option(
            "--cluster", metavar="ADDRESS", help="In simulation: Dask scheduler that swims them."
        ),
        click.option(
            "--jobs", type=click.IntRange(min=1), help="In simulation: processes. [default: cores]"
        ),
        click.option(
            "--folder",
            type=click.Path(path_type=Path),
            help="Where table, recordings and picture go; a sweep that began there is "
            "resumed. [default: runs/sweep-DATE-TIME]",
        ),
        click.option(
            "--for",
            "seconds",
            type=FiniteRange(min=0.0, min_open=True),
            help="On a robot: swimming and resting at each point [s]. [default: 30]",
        ),
        click.option(
            "--periods",
            type=click.IntRange(min=2),
            help="In simulation: tail beats judged at each point; of a swimmer, at least. "
            "[default: 20; of a swimmer 10]",
        ),
        click.option(
            "--settle",
            type=FiniteRange(min=0.0),
            help="In simulation: time before they are judged [s]. [default: 10; of a swimmer 4, or "
            "until its speed is steady]",
        ),
        click.option(
            "--vary",
            multiple=True,
            metavar="KEY=VALUES",
            help="In simulation: a key of the configuration with several values, such as "
            "plant.xi=0.6,1.2,2.4 or plant.omega0=8:14:2. Repeatable.",
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

    Of a fish that swims freely (robot: swimmer), the speed.

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
    from fishd.lab import drawing
    from fishd.lab.sweep import grid

    drawing.check_installed()
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
        whole, kept = _on_robot(path, found, seconds or 30.0, endpoint, as_json)
        error_of = "the measurement"
    else:
        keys = dict(_varied(text) for text in vary)
        found = grid.points(names, parameters, takes, keys)
        lengths = {"settle": settle, "periods": periods}
        crew = {"jobs": jobs, "cluster": cluster}
        whole, kept = _in_simulation(path, found, file, overrides, lengths, crew, as_json)
        error_of = "the mean over beats"
    units = {field.name: field.unit for info in infos for field in info.parameters}
    return conclude(kept, found, units, error_of, whole, as_json)


def refuse_other(on: str, of_simulation: dict[str, Any], of_robot: dict[str, Any]) -> None:
    """Refuse options that mean nothing where the fish is; raises `UsageError`."""
    for name, value in (of_simulation if on == "robot" else of_robot).items():
        if value not in (None, ()):
            where = "is for --on simulation: a running fishd keeps its configuration"
            if name not in ("--config", "--set", "--vary"):
                where = f"is for --on {'simulation' if on == 'robot' else 'robot'}"
            raise click.UsageError(f"{name} {where}")


def _varied(text: str) -> tuple[str, list[Any]]:
    from fishd.lab.sweep.grid import spread, typed

    key, equals, values = text.partition("=")
    if not (equals and key.strip()):
        raise click.UsageError(f"--vary {text}: write KEY=VALUES, such as plant.xi=0.6,1.2,2.4")
    return key.strip(), list(dict.fromkeys(map(typed, spread(values))))


def _in_simulation(
    path: Path,
    found: "list[Point]",
    file: Path | None,
    overrides: tuple[str, ...],
    given: dict[str, Any],
    crew: dict[str, Any],
    err: bool,
) -> "tuple[bool, SweepFolder]":
    from fishd.lab.sweep import grid, running
    from fishd.lab.sweep.folder import Begun
    from fishd.lab.sweep.grid import Lengths

    fish: dict[tuple[tuple[str, Any], ...], Config] = {}
    pairs = []
    for point in found:
        changed = tuple(point.keys.items())
        if changed not in fish:
            fish[changed] = _fish_of(point, file, overrides)
        grid.check(point, replace(fish[changed].limits, virtual=True))
        pairs.append((point, fish[changed]))
    config = load(file, overrides)
    lengths = Lengths.of(config, **given)
    begun = Begun("simulation", msgspec.to_builtins(config), msgspec.to_builtins(lengths))
    with (
        _opened(path, begun, found) as folder,
        telling(folder, found, "points", 1.0, err) as count,
    ):
        whole = running.in_simulation(folder, pairs, lengths, count.done, **crew)
    return whole, folder


def _fish_of(point: "Point", file: Path | None, overrides: tuple[str, ...]) -> Config:
    pairs = [f"{key}={value}" for key, value in point.keys.items()]
    try:
        return load(file, (*overrides, *pairs))
    except ConfigError as error:
        message = str(error)
        for pair in pairs:
            message = message.replace(f"--set {pair}", f"--vary {pair}")
        raise ConfigError(message) from None


def _on_robot(
    path: Path, found: "list[Point]", seconds: float, endpoint: str | None, err: bool
) -> "tuple[bool, SweepFolder]":
    from fishd.lab.measurement import plan
    from fishd.lab.rig import Disturbed, LiveRig
    from fishd.lab.sweep import grid, running
    from fishd.lab.sweep.folder import Begun

    for point in found:
        plan(seconds, point.parameters)  # which says that it is too short, before anything moves
    with Fish(endpoint) as fish:
        status = fish.status()
        check_tethered(status.robot, "sweep --on robot")
        grid.check_remote(found, Limits(status.amplitude_limit, status.tick))
        rig = LiveRig(fish, *verb_lease())
        begun = Begun("robot", fish.config(), {"seconds": seconds}, status.force_unit)
        with (
            _opened(path, begun, found) as folder,
            telling(folder, found, "s", seconds, err) as count,
        ):
            try:
                whole = running.on_robot(folder, found, rig, seconds, count.done, count.at)
            except (Disturbed, NoDaemon) as error:
                raise FishdError(f"{error}; to go on: {again(path)}") from None
    return whole, folder


@contextmanager
def _opened(path: Path, begun: "Begun", found: "list[Point]") -> "Iterator[SweepFolder]":
    from fishd.lab.begun import owned
    from fishd.lab.sweep.folder import SweepFolder

    columns = dict.fromkeys(name for point in found for name in point.columns())
    with owned(path, "sweep"):
        folder = SweepFolder(path, begun, list(columns))
        yield folder
        folder.sort(found)
