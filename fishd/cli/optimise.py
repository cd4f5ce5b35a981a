"""The verb that searches the best parameters of a controller."""

import contextlib
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from msgspec import Struct
from msgspec.structs import replace

from fishd.cli.config import set_option
from fishd.cli.lab_progress import showing
from fishd.cli.options import ControllerGroup, ParameterType, endpoint_option, json_option
from fishd.cli.output import counted, echo, print_json
from fishd.cli.sweep import ON, refuse_other
from fishd.client import Fish
from fishd.config import Config, Start, load
from fishd.controllers import registry
from fishd.core.console import INTERRUPTED
from fishd.core.errors import ParameterError
from fishd.core.interruption import interrupted_once
from fishd.core.schema import Field, nearest
from fishd.simulation import simulate

if TYPE_CHECKING:
    from fishd.lab.optimise.search import Proposal, Range
    from fishd.lab.optimise.trials import Trial
    from fishd.lab.rig import Rig


class Optimum(Struct, frozen=True):
    """What a search found, as a program reads it."""

    controller: str
    parameters: dict[str, float]
    low: dict[str, float]
    """The 95 % interval of each."""
    high: dict[str, float]
    thrust: float
    """[N]"""
    error: float
    """Half of its 95 % interval [N]."""
    improvement: float
    """Expected of another trial, as a share of the thrust."""
    trials: int
    ticks_swum: int
    seconds: float
    """In the tank, rest included [s]."""
    true_thrust: float | None = None
    """There, of a simulated fish [N]."""
    efficiency: float | None = None
    """That over the thrust of the best square wave."""


def optimise_options(function: Any) -> Any:
    """The options of the verb itself."""
    for option in (
        json_option,
        endpoint_option,
        click.option(
            "--folder",
            type=click.Path(path_type=Path),
            help="Where table, recording and picture go; must be new. "
            "[default: runs/optimise-DATE-TIME]",
        ),
        click.option("--seed", type=click.IntRange(min=0), default=0, help="Of the search."),
        click.option(
            "--until",
            type=click.FloatRange(0.0, 1.0),
            default=0.01,
            show_default=True,
            help="Stop where another trial is expected to give no more, as a share of the thrust.",
        ),
        click.option(
            "--budget",
            type=click.FloatRange(min=0.0, min_open=True),
            default=300.0,
            show_default=True,
            help="Time in the tank at most, rest included [s].",
        ),
        click.option(
            "--config",
            "file",
            type=click.Path(path_type=Path, readable=False),
            help="In simulation: YAML file of the fish; without it, the defaults.",
        ),
        set_option,
        ON,
        click.option(
            "--over",
            multiple=True,
            required=True,
            metavar="NAME[=LOW:HIGH]",
            help="A parameter to search, within its bounds or between these. Repeatable.",
        ),
    ):
        function = option(function)
    return function


@click.group(cls=ControllerGroup, options=optimise_options, remote=True)
def optimise() -> None:
    """Search the parameters with which a controller thrusts most, in a minute of swimming.

    The fish swims with a candidate, rests, and swims with the next, which a Gaussian process
    chooses from all that was measured, each with its error. Other parameters may be given, too.
    """


@optimise.action
def _optimise(
    name: str,
    parameters: dict[str, Any],
    over: tuple[str, ...],
    on: str,
    file: Path | None,
    overrides: tuple[str, ...],
    budget: float,
    until: float,
    seed: int,
    folder: Path | None,
    endpoint: str | None,
    as_json: bool,
) -> int:
    from fishd.lab.measurement import REST
    from fishd.lab.optimise.folder import SearchFolder, draw
    from fishd.lab.optimise.search import Search
    from fishd.lab.optimise.trials import lengths, trials

    refuse_other(on, {"--config": file, "--set": overrides}, {})
    path = folder or Path("runs") / f"optimise-{datetime.now():%Y%m%d-%H%M%S}"
    with _fish(on, file, overrides, endpoint) as (rig, config, unit):
        ranges = [_range(text, name, parameters, rig) for text in over]
        search = Search(ranges, seed)
        if on == "simulation":
            for end in ("low", "high"):
                ends = {each.name: getattr(each, end) for each in ranges}
                registry.check(name, {**parameters, **ends}, load(file, overrides).limits)
        if budget < (least := 2.0 * REST + lengths(parameters)[1]):
            raise ParameterError(
                f"a budget of {budget:g} s is too short: one candidate takes {least:.3g} s"
            )
        run = SearchFolder(path, rig.name, config, [each.name for each in ranges])
        found, whole = None, True
        last: Trial | None = None
        try:
            with interrupted_once(), rig, run, showing(budget, "s", err=as_json) as show:
                show.at(REST)
                for last in trials(rig, name, parameters, search, budget):
                    run.keep(last)
                    found = search.proposal()
                    shown = found if search.is_warm else None
                    show.done(_told(search.trials, last, shown, unit), last.passed)
                    if search.is_warm and found.improvement <= until:
                        break
        except KeyboardInterrupt:
            whole = False
    if last is None or found is None:
        if whole:
            raise ParameterError(f"a budget of {budget:g} s is too short for the first candidate")
        echo("fishctl: stopped before the first candidate was measured", err=True)
        return INTERRUPTED
    optimum = _optimum(name, search.trials, last, found)
    if on == "simulation":
        report = simulate(load(file, overrides), name, {**parameters, **found.parameters})
        optimum = replace(optimum, true_thrust=report.mean_thrust, efficiency=report.efficiency)
    units = {each: field.unit for each, field in _fields().items()}
    picture = draw(path, search, found, units, unit)
    if as_json:
        print_json(optimum)
    else:
        _say(optimum, unit, units, path, picture)
    if not whole:
        echo("fishctl: stopped before its end: this is the best so far", err=True)
        return INTERRUPTED
    if found.improvement > until or not search.is_warm:
        echo(
            f"fishctl: the budget of {budget:g} s is used: another candidate is expected to give "
            f"{found.improvement:.1%} more, not {until:.1%} as asked for",
            err=True,
        )
        return 1
    return 0


@contextlib.contextmanager
def _fish(
    on: str, file: Path | None, overrides: tuple[str, ...], endpoint: str | None
) -> "Iterator[tuple[Rig, Config | dict[str, Any], str]]":
    """What swims, its configuration, and the unit of its forces."""
    from fishd.lab.rig import LiveRig, VirtualRig

    if on == "simulation":
        config = replace(load(file, overrides), start=Start())
        yield VirtualRig(config), config, "N"
        return
    with Fish(endpoint) as fish:
        yield LiveRig(fish), fish.config(), fish.status().force_unit


def _fields() -> dict[str, Field]:
    """The parameters of the controller of this command line."""
    types = (param.type for param in click.get_current_context().command.params)
    return {kind.field.name: kind.field for kind in types if isinstance(kind, ParameterType)}


def _range(text: str, controller: str, given: dict[str, Any], rig: "Rig") -> "Range":
    """`frequency`, or `frequency=1:3`; raises `UsageError`."""
    from fishd.lab.optimise.search import Range
    from fishd.lab.optimise.trials import default_range, whole_ticks

    name, equals, ends = text.partition("=")
    known = _fields()
    if name not in known or known[name].kind != "number":
        numbers = [each for each, field in known.items() if field.kind == "number"]
        hint = nearest(name, numbers, listed="it has") if numbers else "it has none"
        raise click.UsageError(f"--over {text}: {controller} has no such number; {hint}")
    if name in given:
        raise click.UsageError(f"--over {text}: --{name} is given, too")
    if not equals:
        found = default_range(known[name], rig)
        if found is None:
            raise click.UsageError(
                f"--over {name}: it has no bounds on both sides: write --over {name}=LOW:HIGH"
            )
        return whole_ticks(found, rig.tick) if name == "frequency" else found
    try:
        low, high = (float(end) for end in ends.split(":"))
    except ValueError:
        raise click.UsageError(
            f"--over {text}: write NAME=LOW:HIGH, such as frequency=0.5:4"
        ) from None
    found = Range(name, low, high)
    found.check()
    return whole_ticks(found, rig.tick) if name == "frequency" else found


def _told(number: int, trial: "Trial", best: "Proposal | None", unit: str) -> str:
    """best: what seems so, once there is enough to say it"""
    measured = (
        f"{number}: {_spelled(trial.parameters)}: {trial.thrust * 1e3:.2f} ± "
        f"{trial.error * 1e3:.2f} m{unit}"
    )
    if best is None:
        return measured
    more = f"another may give {best.improvement:.1%} more"
    return f"{measured}; best so far {_spelled(best.parameters)}, {more}"


def _spelled(parameters: dict[str, float]) -> str:
    return " ".join(f"{name}={value:.4g}" for name, value in parameters.items())


def _optimum(name: str, trials: int, last: "Trial", found: "Proposal") -> Optimum:
    return Optimum(
        controller=name,
        parameters=found.parameters,
        low=found.low,
        high=found.high,
        thrust=found.thrust,
        error=found.error,
        improvement=found.improvement,
        trials=trials,
        ticks_swum=last.swum,
        seconds=last.passed,
    )


def _say(
    found: Optimum, unit: str, units: dict[str, str], path: Path, pictures: list[Path]
) -> None:
    for name, value in found.parameters.items():
        symbol = "" if units[name] in ("", "1") else f" {units[name]}"
        interval = f"[{found.low[name]:.4g}, {found.high[name]:.4g}]"
        echo(f"best {name} of {found.controller}: {value:.4g}{symbol} {interval}")
    echo(f"thrust there: {found.thrust * 1e3:.2f} ± {found.error * 1e3:.2f} m{unit}")
    if found.true_thrust is not None:
        echo(
            f"true thrust there: {found.true_thrust * 1e3:.2f} mN, {found.efficiency:.1%} of the "
            "best square wave"
        )
    echo(
        f"{counted(found.trials, 'candidate')}, {found.ticks_swum} ticks of swimming, "
        f"{found.seconds:.0f} s with the rests"
    )
    echo(f"table: {path / 'trials.csv'}")
    echo(f"picture: {pictures[0]}, and as {pictures[1].suffix[1:].upper()}")
