"""The verb that searches the best parameters of a controller."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click
from msgspec import Struct
from msgspec.structs import replace

from fishd.cli.experiment_options import ChosenFish, Ending, Place, fish_choice, folder_options
from fishd.cli.options import (
    ControllerGroup,
    FiniteRange,
    ParameterType,
    json_option,
    plot_option,
    seed_option,
)
from fishd.cli.output import echo, format_count, print_json, warn_of_fin
from fishd.cli.progress import show_progress
from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.core import text
from fishd.core.console import power_words
from fishd.core.errors import ParameterError
from fishd.core.schema import Field, format_values, nearest, units_of

if TYPE_CHECKING:
    from fishd.core.calibration import ForceCalibration
    from fishd.lab.experiment import Experiment
    from fishd.lab.optimise.aim import Aim
    from fishd.lab.optimise.least_power import LeastPower
    from fishd.lab.optimise.search import Proposal, Range, Search
    from fishd.lab.optimise.trials import Trial
    from fishd.lab.session import Session


def optimise_options(function: Any) -> Any:
    """The options of the verb itself."""
    for option in (
        json_option,
        plot_option("the candidates and what is expected"),
        fish_choice,
        folder_options,
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
        seed_option("the search"),
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
            metavar="SECONDS",
            default=300.0,
            show_default=True,
            help="Largest tank time, rests included [s].",
        ),
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


@click.group(cls=ControllerGroup, options=optimise_options, remote=True, resumable=True)
def optimise() -> None:
    """Search the parameters with which a controller thrusts most, in a minute of swimming.

    The fish swims with a candidate, rests, and swims with the next, which a Gaussian process
    chooses from all that was measured, each with its error. Other parameters may be given, too.
    With --resume an interrupted search goes on, and may have a larger --budget.
    """


@optimise.action
def _optimise(
    name: str,
    parameters: dict[str, Any],
    over: tuple[str, ...],
    budget: float,
    until: float,
    seed: int,
    objective: Literal["thrust", "thrust-per-watt"] | None,
    at_least: float | None,
    place: Place,
    fish: ChosenFish,
    picture: Path | None,
    as_json: bool,
) -> int:
    from fishd.lab import drawing
    from fishd.lab.measurement import REST
    from fishd.lab.optimise.aim import Aim
    from fishd.lab.optimise.trials import trial_durations

    drawing.check_installed()
    if picture:
        drawing.check(picture)
    if objective and at_least:
        raise click.UsageError("--objective and --at-least: each is an aim of its own, give one")
    aim = Aim(objective or "thrust", at_least * 1e-3 if at_least else None)
    with fish.session() as session:
        ranges = [_range(text, name, parameters, session) for text in dict.fromkeys(over)]
        search = aim.make_search(ranges, seed)
        _check_ends(name, parameters, ranges, session)
        if budget < (least := 2.0 * REST + trial_durations(parameters)[1]):
            raise ParameterError(
                f"a budget of {budget:g} s is too short: one candidate takes {least:.3g} s"
            )
        settings = {
            "controller": name,
            "parameters": parameters,
            "over": {each.name: [each.low, each.high] for each in ranges},
            "seed": seed,
            "objective": aim.objective,
            "target": aim.target,
        }
        with place.open(fish, session.config, settings, session.unit) as experiment:
            fish.announce(as_json)
            return _Optimisation(
                name, parameters, search, budget, until, aim, session, experiment, fish, as_json
            ).run(picture)


def _check_ends(
    name: str, parameters: dict[str, Any], ranges: "list[Range]", session: "Session"
) -> None:
    """Raise `ParameterError` where the ends of the ranges are not possible for the fish."""
    from fishd.lab.sweep import grid
    from fishd.lab.sweep.grid import Point

    for end in ("low", "high"):
        given = {**parameters, **{each.name: getattr(each, end) for each in ranges}}
        if session.source == "simulation":
            registry.check(name, given, session.read_config().limits)
        else:
            grid.check_remote([Point(name, given)], Limits(session.amplitude, session.tick))


@dataclass
class _Optimisation:
    """One search, as the command line wants it."""

    controller: str
    fixed: dict[str, Any]
    """Parameters that are not searched."""
    search: "Search | LeastPower"
    budget: float
    until: float
    aim: "Aim"
    session: "Session"
    experiment: "Experiment"
    fish: ChosenFish
    as_json: bool

    def __post_init__(self) -> None:
        from fishd.lab.optimise.trials import read_trials

        self.units = units_of(_fields().values())
        self.trials = read_trials(self.experiment, (each.name for each in self.search.ranges))
        for trial in self.trials:
            self.aim.observe(self.search, trial)

    def run(self, picture: Path | None) -> int:
        """Search, print and draw; return the exit status."""
        from fishd.lab.optimise.figure import draw

        ending = Ending(self.experiment)
        waited = self._measure(ending)
        if not self.trials:
            if ending.is_interrupted:
                return ending.interrupted("no candidate is measured yet")
            raise ParameterError(
                f"a budget of {self.budget:g} s is too short for the first candidate"
            )
        proposal = self.search.propose()
        with ending.measuring():
            optimum = self._judge(proposal, waited)
            folder, unit = self.experiment.path, self.session.unit
            if self.as_json:
                print_json(optimum)
            else:
                _print(optimum, unit, self.units)
                echo(f"table: {folder / 'rows.csv'}")
            shown = self._drawn_search()
            paths = [picture] if picture else [folder / "thrust.png", folder / "thrust.svg"]
            draw(paths, shown, proposal, self.units, _label(self.aim, unit))
            if not self.as_json:
                echo(f"picture: {', '.join(map(str, paths))}")
        if ending.is_interrupted:
            return ending.interrupted(f"{format_count(len(self.trials), 'candidate')} are kept")
        if not self._is_done(proposal):
            echo(
                f"fishctl: the budget of {self.budget:g} s is used: another candidate is expected "
                f"to give {proposal.improvement:.1%} more, not {self.until:.1%} as requested; a "
                f"larger one: {self.experiment.resume_command} --budget SECONDS",
                err=True,
            )
            return 1
        return 0

    def _is_done(self, proposal: "Proposal") -> bool:
        return self.search.is_warm and proposal.improvement <= self.until

    def _measure(self, ending: Ending) -> float:
        """Measure candidates until it is done, after those that are there.

        Returns how long the fish waited for the next candidate [s].
        """
        from fishd.lab.optimise.trials import measure_trials, write_trial

        search, session, experiment = self.search, self.session, self.experiment
        last = self.trials[-1] if self.trials else None
        before = session.used = last.passed if last else 0.0
        if last:
            there = format_count(len(self.trials), "candidate")
            echo(f"{experiment.path}: {there} there already", err=self.as_json)
            if self._is_done(search.propose()):
                return 0.0
        begin = time.monotonic()
        observe = partial(self.aim.observe, search)
        with (
            ending.measuring(),
            session,
            session.recorded(experiment.recording("search"), "a search"),
            show_progress(self.budget, "s", err=self.as_json) as show,
        ):
            session.progress = show.at
            for trial in measure_trials(
                session, self.controller, self.fixed, search, self.budget, last, observe
            ):
                write_trial(experiment, trial)
                self.trials.append(trial)
                proposal = search.propose()
                best = proposal if search.is_warm else None
                line = _line(search.trials, trial, best, session.unit, self.units)
                show.done(line, trial.passed)
                if self._is_done(proposal):
                    break
        passed = (self.trials[-1].passed if self.trials else 0.0) - before
        return max(0.0, time.monotonic() - begin - passed)

    def _judge(self, proposal: "Proposal", waited: float) -> "Optimum":
        """Return what the search found, with the truth of a simulated fish."""
        from fishd.lab.simulation import simulate

        optimum = _optimum_of(
            self.controller, self.trials, self.search, proposal, self.aim,
            self.session.calibration,
        )  # fmt: skip
        if self.fish.on == "live":
            return replace(optimum, thinking=waited)
        parameters = {**self.fixed, **proposal.parameters}
        truth = simulate(self.fish.load(), self.controller, parameters)
        warn_of_fin(truth.fin_amplitude)
        return replace(
            optimum,
            true_thrust=truth.mean_thrust,
            relative_thrust=truth.relative_thrust,
            true_power=truth.mean_power,
        )

    def _drawn_search(self) -> "Search":
        """Return the search of the quantity that is drawn."""
        from fishd.lab.optimise.least_power import LeastPower

        if not isinstance(self.search, LeastPower):
            return self.search
        return self.search.with_observations(
            (t.parameters, t.power, t.power_error) for t in self.trials
        )


def _label(aim: "Aim", unit: str) -> str:
    """Of the picture's axis."""
    if aim.target is not None:
        return "power (mW)"
    return f"thrust (m{unit})" if aim.objective == "thrust" else f"thrust per watt (m{unit}/W)"


def _fields() -> dict[str, Field]:
    """The parameters of the controller of this command line."""
    types = (param.type for param in click.get_current_context().command.params)
    return {kind.field.name: kind.field for kind in types if isinstance(kind, ParameterType)}


def _range(text: str, controller: str, given: dict[str, Any], session: "Session") -> "Range":
    """`frequency`, or `frequency=1:3`; raises `UsageError`."""
    from fishd.lab.optimise.search import Range
    from fishd.lab.optimise.trials import check_bounds, default_range, restrict_to_whole_ticks

    name, equals, ends = text.partition("=")
    known = _fields()
    if name not in known or known[name].kind != "number":
        numbers = [each for each, field in known.items() if field.kind == "number"]
        hint = nearest(name, numbers, listed="it has") if numbers else "it has none"
        raise click.UsageError(f"--over {text}: {controller} has no such number; {hint}")
    if name in given:
        raise click.UsageError(f"--over {text}: --{name} is given, too")
    if not equals:
        found = default_range(known[name], session)
        if found is None:
            raise click.UsageError(
                f"--over {name}: it has no bounds on both sides: write --over {name}=LOW:HIGH"
            )
        return restrict_to_whole_ticks(found, session.tick) if name == "frequency" else found
    try:
        low, high = (float(end) for end in ends.split(":"))
    except ValueError:
        raise click.UsageError(
            f"--over {text}: write NAME=LOW:HIGH, such as frequency=0.5:4"
        ) from None
    found = Range(name, low, high)
    found.check()
    check_bounds(found, known[name], session)
    return restrict_to_whole_ticks(found, session.tick) if name == "frequency" else found


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
    """Expected of another trial, as a share of what is searched."""
    trials: int
    ticks_swum: int
    seconds: float
    """In the tank, rest included [s]."""
    objective: str = "thrust"
    target: float | None = None
    """The thrust that was to be reached [N]."""
    power: float | None = None
    """Electrical power of the servo [W]; null where it is not known."""
    power_error: float | None = None
    """Half of its 95 % interval [W]."""
    thrust_per_watt: float | None = None
    """[N/W]"""
    thrust_per_watt_error: float | None = None
    """Half of its 95 % interval [N/W]."""
    calibration_ci95: float | None = None
    """Half-width of the 95 % interval that the calibration leaves to the thrust [N].

    null where its uncertainty is unknown.
    """
    total_ci95: float | None = None
    """Half-width of the 95 % interval by `error` and `calibration_ci95` together [N]."""
    thrust_per_watt_calibration_ci95: float | None = None
    """As `calibration_ci95`, of the thrust for each watt [N/W]."""
    thrust_per_watt_total_ci95: float | None = None
    """As `total_ci95`, of the thrust for each watt [N/W]."""
    rotation: float = 0.0
    """Rotation of the sensor's axes that is left after calibration; 0 where none is seen [rad]."""
    thinking: float | None = None
    """How long the fish of a robot waited besides while candidates were chosen, this time [s]."""
    true_thrust: float | None = None
    """There, of a simulated fish [N]."""
    relative_thrust: float | None = None
    """That over the thrust of the best square wave."""
    true_power: float | None = None
    """There, of a simulated servo [W]."""


def _line(
    number: int, trial: "Trial", best: "Proposal | None", unit: str, units: dict[str, str]
) -> str:
    """A line on a trial.

    best: what seems so, once there is enough to say it
    unit: of the force; units: of the parameters
    """
    thrust = text.format_measured(trial.thrust, trial.error, unit)
    measured = f"{number}: {_spelled(trial.parameters, units)}: {thrust}"
    if math.isfinite(trial.power):
        measured += f" for {power_words(trial.power)}"
    if best is None:
        return measured
    more = f"another may give {best.improvement:.1%} more"
    return f"{measured}; best so far {_spelled(best.parameters, units)}, {more}"


def _spelled(parameters: dict[str, float], units: dict[str, str]) -> str:
    return format_values({name: float(f"{value:.4g}") for name, value in parameters.items()}, units)


def _optimum_of(
    name: str,
    measured: "Sequence[Trial]",
    search: "Search | LeastPower",
    found: "Proposal",
    aim: "Aim",
    calibration: "ForceCalibration",
) -> Optimum:
    """What a search found; measured: all that it knows of; calibration: of the force sensor"""
    from fishd.lab.error_budget import budget
    from fishd.lab.statistics import per_watt

    last = measured[-1]
    force = [(each.parameters, each.thrust, each.error) for each in measured]
    thrust, error = search.with_observations(force).predict(found.parameters)
    power = power_error = None
    if all(math.isfinite(each.power) for each in measured):
        taken = [(each.parameters, each.power, each.power_error) for each in measured]
        power, power_error = search.with_observations(taken).predict(found.parameters)
    gives, gives_error = per_watt(thrust, error, power, power_error)
    if aim.objective == "thrust-per-watt" and aim.target is None:
        gives, gives_error = found.value, found.error
    rotations = [each.rotation for each in measured if each.rotation]
    rotation = sum(rotations) / len(rotations) if rotations else 0.0
    whole = budget(calibration, thrust, error, rotation=rotation)
    whole_per_watt = (
        None if gives is None else budget(calibration, gives, gives_error, rotation=rotation)
    )
    return Optimum(
        controller=name,
        parameters=found.parameters,
        low=found.low,
        high=found.high,
        thrust=thrust,
        error=error,
        improvement=found.improvement,
        trials=len(measured),
        objective=aim.objective if aim.target is None else "least-power",
        target=aim.target,
        power=power,
        power_error=power_error,
        thrust_per_watt=gives,
        thrust_per_watt_error=gives_error,
        calibration_ci95=whole.calibration_ci95,
        total_ci95=whole.total_ci95,
        rotation=rotation,
        thrust_per_watt_calibration_ci95=whole_per_watt and whole_per_watt.calibration_ci95,
        thrust_per_watt_total_ci95=whole_per_watt and whole_per_watt.total_ci95,
        ticks_swum=last.swum,
        seconds=last.passed,
    )


def _print(found: Optimum, unit: str, units: dict[str, str]) -> None:
    """Show what was found; units: of the parameters, unit: of the force."""
    from fishd.lab import error_budget

    for name, value in found.parameters.items():
        symbol = "" if units[name] in ("", "1") else f" {units[name]}"
        interval = f"[{found.low[name]:.4g}, {found.high[name]:.4g}]"
        echo(f"best {name} of {found.controller}: {value:.4g}{symbol} {interval}")
    thrust = error_budget.spelled(
        found.thrust, found.error, found.calibration_ci95, found.total_ci95, unit
    )
    echo(f"thrust there: {thrust}")
    if found.power is not None and found.power_error is not None:
        gives = error_budget.spelled(
            found.thrust_per_watt or 0.0,
            found.thrust_per_watt_error or 0.0,
            found.thrust_per_watt_calibration_ci95,
            found.thrust_per_watt_total_ci95,
            f"{unit} per W",
        )
        echo(f"power there: {found.power * 1e3:.0f} ± {found.power_error * 1e3:.0f} mW, {gives}")
    unknown = error_budget.unknown_calibration(found.calibration_ci95, unit)
    for line in filter(None, (unknown, error_budget.rotation_remark(found.rotation))):
        echo(f"fishctl: {line}", err=True)
    if found.target is not None and found.thrust < found.target:
        echo(f"fishctl: no parameters are known that give {found.target * 1e3:g} m{unit}", err=True)
    if found.true_thrust is not None:
        taking = "" if found.true_power is None else f" for {power_words(found.true_power)}"
        echo(
            f"true thrust there: {found.true_thrust * 1e3:.2f} mN{taking}, "
            f"{found.relative_thrust:.1%} of the best square wave"
        )
    thinking = "" if found.thinking is None else f"; {found.thinking:.0f} s of thinking besides"
    echo(
        f"{format_count(found.trials, 'candidate')}, {found.ticks_swum} ticks of swimming, "
        f"{found.seconds:.0f} s with the rests{thinking}"
    )
