"""The verb that searches the best parameters of a controller."""

import contextlib
import time
from collections.abc import Iterator
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import click
import msgspec
from msgspec.structs import replace

from fishd.cli.config import set_option
from fishd.cli.lab_progress import showing
from fishd.cli.lease_options import take_option, verb_lease
from fishd.cli.optimise_output import optimum_of, say, told
from fishd.cli.options import (
    ControllerGroup,
    FiniteRange,
    ParameterType,
    endpoint_option,
    json_option,
)
from fishd.cli.output import counted, echo, print_json, warn_of_fin
from fishd.cli.sweep import ON, refuse_other
from fishd.cli.sweep_output import again
from fishd.client import Fish
from fishd.config import Start, load
from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError, NoDaemon, ParameterError
from fishd.core.process.interruption import interrupted_once
from fishd.core.schema import Field, nearest, units_of
from fishd.lab.simulation import simulate

if TYPE_CHECKING:
    from fishd.lab.optimise.aim import Aim
    from fishd.lab.optimise.folder import SearchFolder
    from fishd.lab.optimise.least_power import LeastPower
    from fishd.lab.optimise.search import Proposal, Range, Search
    from fishd.lab.optimise.trials import Trial
    from fishd.lab.rig import Rig


def optimise_options(function: Any) -> Any:
    """The options of the verb itself."""
    for option in (
        json_option,
        endpoint_option,
        take_option,
        click.option(
            "--folder",
            type=click.Path(path_type=Path),
            help="Where table, recordings and picture go; a search that began there is "
            "resumed. [default: runs/optimise-DATE-TIME]",
        ),
        click.option(
            "--at-least",
            type=FiniteRange(min=0.0, min_open=True),
            metavar="MN",
            help="A thrust [mN]: find the parameters that give it for the least power.",
        ),
        click.option(
            "--objective",
            type=click.Choice(["thrust", "thrust-per-watt"]),
            help="What to maximise: thrust, or thrust per watt of the servo's electrical power. "
            "[default: thrust]",
        ),
        click.option("--seed", type=click.IntRange(min=0), default=0, help="Of the search."),
        click.option(
            "--until",
            type=FiniteRange(0.0, 1.0),
            default=0.01,
            show_default=True,
            help="Stop once another trial is expected to gain less than this share of the thrust.",
        ),
        click.option(
            "--budget",
            type=FiniteRange(min=0.0, min_open=True),
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
    objective: Literal["thrust", "thrust-per-watt"] | None,
    at_least: float | None,
    folder: Path | None,
    endpoint: str | None,
    as_json: bool,
) -> int:
    from fishd.lab import drawing
    from fishd.lab.begun import owned
    from fishd.lab.measurement import REST
    from fishd.lab.optimise.aim import Aim
    from fishd.lab.optimise.folder import Begun, SearchFolder, draw
    from fishd.lab.optimise.least_power import LeastPower
    from fishd.lab.optimise.trials import lengths
    from fishd.lab.sweep import grid
    from fishd.lab.sweep.grid import Point

    drawing.check_installed()
    if objective and at_least:
        raise click.UsageError("--objective and --at-least: each is an aim of its own, give one")
    aim = Aim(objective or "thrust", at_least * 1e-3 if at_least else None)
    refuse_other(on, {"--config": file, "--set": overrides}, {})
    path = folder or Path("runs") / f"optimise-{datetime.now():%Y%m%d-%H%M%S}"
    with _fish(on, file, overrides, endpoint) as (rig, config):
        ranges = [_range(text, name, parameters, rig) for text in over]
        search = aim.search(ranges, seed)
        for end in ("low", "high"):
            ends = {each.name: getattr(each, end) for each in ranges}
            if on == "simulation":
                registry.check(name, {**parameters, **ends}, load(file, overrides).limits)
            else:
                of_fish = Limits(rig.amplitude, rig.tick)
                grid.check_remote([Point(name, {**parameters, **ends})], of_fish)
        if budget < (least := 2.0 * REST + lengths(parameters)[1]):
            raise ParameterError(
                f"a budget of {budget:g} s is too short: one candidate takes {least:.3g} s"
            )
        searched = {each.name: (each.low, each.high) for each in ranges}
        unit = rig.unit
        begun = Begun(on, name, parameters, searched, seed, config, unit, aim.objective, aim.target)
        with owned(path, "search"):
            run = SearchFolder(path, begun)
            task = _Task(name, parameters, search, budget, until, aim)
            whole, measured, thinking = _measured(task, rig, run, unit, as_json)
    if not measured:
        if whole:
            raise ParameterError(f"a budget of {budget:g} s is too short for the first candidate")
        echo(f"fishctl: stopped before the first candidate; to go on: {again(path)}", err=True)
        return INTERRUPTED
    try:
        with interrupted_once():
            found = search.proposal()
            optimum = optimum_of(name, measured, search, found, aim, rig.calibration)
            if on == "simulation":
                swum = simulate(load(file, overrides), name, {**parameters, **found.parameters})
                truth = {"true_thrust": swum.mean_thrust, "relative_thrust": swum.relative_thrust}
                optimum = replace(optimum, **truth, true_power=swum.mean_power)
                warn_of_fin(swum.fin_amplitude)
            else:
                optimum = replace(optimum, thinking=thinking)
            units = units_of(_fields().values())
    except KeyboardInterrupt:
        echo(f"fishctl: stopped before the best was told; to go on: {again(path)}", err=True)
        return INTERRUPTED
    try:
        with interrupted_once():
            if as_json:
                print_json(optimum)
            else:
                say(optimum, unit, units, path)
            shown = (
                search.alike((one.parameters, one.power, one.power_error) for one in measured)
                if isinstance(search, LeastPower)
                else search
            )
            pictures = draw(path, shown, found, units, _label(aim, unit))
            if not as_json:
                echo(f"picture: {pictures[0]}, and as {pictures[1].suffix[1:].upper()}")
    except KeyboardInterrupt:
        whole = False
    if not whole:
        echo(
            f"fishctl: stopped before its end: this is the best so far; to go on: {again(path)}",
            err=True,
        )
        return INTERRUPTED
    if not task.is_done(found):
        echo(
            f"fishctl: the budget of {budget:g} s is used: another candidate is expected to give "
            f"{found.improvement:.1%} more, not {until:.1%} as asked for; a larger --budget goes "
            f"on with --folder {path}",
            err=True,
        )
        return 1
    return 0


class _Task(NamedTuple):
    """What is to be searched, and when it ends."""

    controller: str
    fixed: dict[str, Any]
    search: "Search | LeastPower"
    budget: float
    until: float
    aim: "Aim"

    def is_done(self, found: "Proposal") -> bool:
        return self.search.is_warm and found.improvement <= self.until


def _measured(
    task: _Task, rig: "Rig", run: "SearchFolder", unit: str, err: bool
) -> "tuple[bool, list[Trial], float]":
    """Measure candidates until it is done, after those that are there.

    Returns False where a signal ended it before, all candidates, and how long the fish of a
    robot waited for the next one [s].
    """
    from fishd.lab.optimise.trials import trials
    from fishd.lab.rig import Disturbed

    search = task.search
    for each in run.done:
        task.aim.observe(search, each)
    measured = list(run.done)
    units = units_of(_fields().values())
    last = measured[-1] if measured else None
    observe = partial(task.aim.observe, search)
    before = last.passed if last else 0.0
    whole = True
    begin = time.monotonic()
    if last:
        echo(f"{run.path}: {counted(len(run.done), 'candidate')} there already", err=err)
    if last and task.is_done(search.proposal()):
        return whole, measured, 0.0
    try:
        with (
            interrupted_once(),
            rig,
            run.recorded(rig),
            showing(task.budget, "s", err=err) as show,
        ):
            show.at(before)
            for each in trials(
                rig, task.controller, task.fixed, search, task.budget, last, observe
            ):
                run.keep(each)
                measured.append(each)
                found = search.proposal()
                shown = found if search.is_warm else None
                show.done(told(search.trials, each, shown, unit, units), each.passed)
                if task.is_done(found):
                    break
    except KeyboardInterrupt:
        whole = False
    except (Disturbed, NoDaemon) as error:
        raise FishdError(f"{error}; to go on: {again(run.path)}") from None
    waited = time.monotonic() - begin - ((measured[-1].passed if measured else 0.0) - before)
    return whole, measured, max(0.0, waited)


def _label(aim: "Aim", unit: str) -> str:
    """Of the picture's axis."""
    if aim.target is not None:
        return "power (mW)"
    return f"thrust (m{unit})" if aim.objective == "thrust" else f"thrust per watt (m{unit}/W)"


@contextlib.contextmanager
def _fish(
    on: str, file: Path | None, overrides: tuple[str, ...], endpoint: str | None
) -> "Iterator[tuple[Rig, dict[str, Any]]]":
    """What swims, and its configuration."""
    from fishd.lab.rig import LiveRig, VirtualRig

    if on == "simulation":
        config = replace(load(file, overrides), start=Start())
        yield VirtualRig(config), msgspec.to_builtins(config)
        return
    with Fish(endpoint) as fish:
        yield LiveRig(fish, *verb_lease()), fish.config()


def _fields() -> dict[str, Field]:
    """The parameters of the controller of this command line."""
    types = (param.type for param in click.get_current_context().command.params)
    return {kind.field.name: kind.field for kind in types if isinstance(kind, ParameterType)}


def _range(text: str, controller: str, given: dict[str, Any], rig: "Rig") -> "Range":
    """`frequency`, or `frequency=1:3`; raises `UsageError`."""
    from fishd.lab.optimise.search import Range
    from fishd.lab.optimise.trials import check_bounds, default_range, whole_ticks

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
    check_bounds(found, known[name], rig)
    return whole_ticks(found, rig.tick) if name == "frequency" else found
