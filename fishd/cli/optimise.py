"""The verb `fishctl optimise`, which searches the best parameters of a controller."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import click
from msgspec import Struct
from msgspec.structs import replace

from fishd.cli.controller_arguments import ParameterType
from fishd.cli.experiment_options import (
    ChosenFish,
    ExperimentEnding,
    ExperimentFolder,
    ResumableGroup,
    fish_choice,
    folder_options,
)
from fishd.cli.options import FiniteRange, json_option, plot_option, seed_option
from fishd.cli.output import echo, format_count, print_json, warn_of_fin
from fishd.cli.progress import show_progress
from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.core import text
from fishd.core.console import format_power
from fishd.core.errors import ParameterError
from fishd.core.schema import Field, format_values, units_of

if TYPE_CHECKING:
    from fishd.core.calibration import ForceCalibration
    from fishd.lab.experiment import Experiment
    from fishd.lab.optimise.least_power import LeastPower
    from fishd.lab.optimise.search import Proposal, Range, Search
    from fishd.lab.optimise.trials import Aim, Trial
    from fishd.lab.session import Session


class OpenRange(NamedTuple):
    """Range of a parameter on the command line; None stands for a bound of the parameter."""

    low: float | None
    high: float | None


class RangeType(ParameterType):
    """Value of a parameter, or the range in which it is searched."""

    metavar = "|LOW:HIGH|:"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert `1:3`, `1:` or `:` to an `OpenRange`, other texts to a value."""
        is_range = isinstance(value, str) and (":" in value or "," in value)
        if not is_range or self.field.kind != "number":
            return super().convert(value, param, ctx)
        try:
            low, high = value.split(":")
        except ValueError:
            self.fail(
                f"'{value}' is not valid: LOW:HIGH is needed, such as 0.5:4, or ':' for all that "
                "is permitted",
                param,
                ctx,
            )
        ends = [
            super(RangeType, self).convert(end, param, ctx) if end else None for end in (low, high)
        ]
        return OpenRange(*ends)


def optimise_options(function: Any) -> Any:
    """Add the options of the verb itself."""
    for option in (
        json_option,
        plot_option("the candidates and what is expected"),
        fish_choice,
        folder_options,
        click.option(
            "--target-thrust",
            type=FiniteRange(min=0.0, min_open=True),
            metavar="MN",
            help="Thrust to reach [mN]: find the parameters that give it at the least power.",
        ),
        click.option(
            "--objective",
            type=click.Choice(["thrust", "thrust-per-watt"]),
            help="What to maximise: thrust, or thrust per watt of the servo's electrical power. "
            "[default: thrust]",
        ),
        seed_option("the search"),
        click.option(
            "--min-gain",
            type=FiniteRange(0.0, 1.0),
            default=0.01,
            show_default=True,
            help="Stop once the expected gain of another trial is less than this fraction.",
        ),
        click.option(
            "--budget",
            type=FiniteRange(min=0.0, min_open=True),
            metavar="SECONDS",
            default=300.0,
            show_default=True,
            help="Largest tank time, rests included [s].",
        ),
    ):
        function = option(function)
    return function


@click.group(cls=ResumableGroup, options=optimise_options, remote=True, kind=RangeType)
def optimise() -> None:
    """Search the parameters of a controller that give the most thrust, in a minute of swimming.

    A parameter with a range is searched, such as --frequency 0.5:4; ':' is the range of all that
    is permitted. A parameter with a value has this value.

    The fish swims with a candidate, rests, and swims with the next. A Gaussian process chooses
    the candidates from all measurements and their errors. At the end the best one swims for
    longer, and this measurement is the result.
    --resume continues an interrupted search; --budget may then be larger.
    """


@optimise.action
def _optimise(
    name: str,
    parameters: dict[str, Any],
    budget: float,
    min_gain: float,
    seed: int,
    objective: Literal["thrust", "thrust-per-watt"] | None,
    target_thrust: float | None,
    place: ExperimentFolder,
    fish: ChosenFish,
    picture: Path | None,
    as_json: bool,
) -> int:
    from fishd.lab import drawing
    from fishd.lab.optimise.trials import Aim, trial_durations
    from fishd.lab.swim_plan import MEAN_REST_S

    drawing.check_installed()
    if picture:
        drawing.check(picture)
    if objective and target_thrust:
        raise click.UsageError(
            "--objective and --target-thrust exclude each other: give one of them"
        )
    aim = Aim(objective or "thrust", target_thrust * 1e-3 if target_thrust else None)
    with fish.session() as session:
        ranges, parameters = _take_ranges(name, parameters, session)
        search = aim.make_search(ranges, seed)
        _check_ends(name, parameters, ranges, session)
        if budget < (least := 2.0 * MEAN_REST_S + trial_durations(parameters)[1]):
            raise ParameterError(
                f"a budget of {budget:g} s is too short: one candidate takes {least:.3g} s"
            )
        settings = {
            "controller": name,
            "parameters": parameters,
            "ranges": {searched.name: [searched.low, searched.high] for searched in ranges},
            "seed": seed,
            "objective": aim.objective,
            "target": aim.target,
        }
        with place.open(fish, settings, session) as experiment:
            fish.announce(as_json)
            return _Optimisation(
                name, parameters, search, budget, min_gain, aim, session, experiment, fish, as_json
            ).run(picture)


def _check_ends(
    name: str, parameters: dict[str, Any], ranges: "list[Range]", session: "Session"
) -> None:
    """Raise `ParameterError` if the fish does not allow the ends of the ranges."""
    from fishd.lab.sweep import grid
    from fishd.lab.sweep.grid import Point

    for end in ("low", "high"):
        candidate = {**parameters, **{searched.name: getattr(searched, end) for searched in ranges}}
        if session.source == "simulation":
            registry.check(name, candidate, session.read_config().limits)
        else:
            grid.check_remote([Point(name, candidate)], Limits(session.amplitude, session.tick))


@dataclass
class _Optimisation:
    """A search from the command line."""

    controller: str
    fixed: dict[str, Any]
    """Parameters that are not searched."""
    search: "Search | LeastPower"
    budget: float
    min_gain: float
    aim: "Aim"
    session: "Session"
    experiment: "Experiment"
    fish: ChosenFish
    as_json: bool

    def __post_init__(self) -> None:
        from fishd.lab.optimise.choice import Choice
        from fishd.lab.optimise.trials import read_trials

        self.units = units_of(_controller_fields().values())
        self.trials = read_trials(
            self.experiment, (searched.name for searched in self.search.ranges)
        )
        self.choice = Choice(self.search, self.aim, self.fixed, self.min_gain, self.trials)

    def run(self, picture: Path | None) -> int:
        """Search, print and draw; return the exit status."""
        from fishd.lab.optimise.figure import draw

        ending = ExperimentEnding(self.experiment)
        waiting = self._measure(ending)
        if not self.trials:
            if ending.is_interrupted:
                return ending.interrupted("before the first candidate was measured")
            raise ParameterError(
                f"a budget of {self.budget:g} s is too short for the first candidate"
            )
        proposal = self.search.propose()
        with ending.measuring():
            optimum = self._judge(proposal, waiting)
            self.experiment.write_result(optimum)
            folder, unit = self.experiment.path, self.session.unit
            if self.as_json:
                print_json(optimum)
            else:
                _print_optimum(optimum, unit, self.units)
                echo(f"table: {folder / 'rows.csv'}")
            drawn_search = self._search_to_draw()
            paths = [picture] if picture else [folder / "thrust.png", folder / "thrust.svg"]
            draw(paths, drawn_search, proposal, self.units, _axis_label(self.aim, unit))
            if not self.as_json:
                echo(f"picture: {', '.join(map(str, paths))}")
        if ending.is_interrupted:
            return ending.interrupted(f"{format_count(len(self.trials), 'candidate')} are kept")
        if not self.choice.is_done(proposal):
            echo(
                f"fishctl: the budget of {self.budget:g} s is used up: another candidate is "
                f"expected to give {proposal.improvement:.1%} more, --min-gain is "
                f"{self.min_gain:.1%}. "
                f"To continue: {self.experiment.resume_command} --budget SECONDS",
                err=True,
            )
            return 1
        return 0

    def _measure(self, ending: ExperimentEnding) -> float:
        """Measure candidates until the search is done; those in the table are kept.

        Return the time that the fish waited for the choice of candidates [s].
        """
        from fishd.lab.optimise.trials import measure_trials, write_trial

        search, session, experiment = self.search, self.session, self.experiment
        last = self.trials[-1] if self.trials else None
        before = session.used = last.tank_time if last else 0.0
        if last:
            count = format_count(len(self.trials), "candidate")
            echo(f"{experiment.path}: {count} measured already", err=self.as_json)
            if self.choice.next(self.budget - before) is None:
                return 0.0
        begin = time.monotonic()
        with (
            ending.measuring(),
            session,
            session.recorded(experiment.recording("search"), "a search"),
            show_progress(self.budget, "s", err=self.as_json) as show,
        ):
            session.progress = show.at
            for trial in measure_trials(
                session, self.controller, self.fixed, self.choice.next, self.budget, last
            ):
                write_trial(experiment, trial)
                self.trials.append(trial)
                self.choice.add(trial)
                best = search.propose() if search.is_warm else None
                line = _format_trial(search.trials, trial, best, session.unit, self.units)
                show.done(line, trial.tank_time)
        passed = (self.trials[-1].tank_time if self.trials else 0.0) - before
        return max(0.0, time.monotonic() - begin - passed)

    def _judge(self, proposal: "Proposal", waited: float) -> "Optimum":
        """Return the result of the search, with the true values of a simulated fish."""
        from fishd.lab.simulation import simulate

        optimum = _make_optimum(
            self.controller, self.trials, self.search, proposal, self.aim,
            self.session.calibration, self.choice.final,
        )  # fmt: skip
        if self.fish.on == "live":
            return replace(optimum, choice_time=waited)
        parameters = {**self.fixed, **optimum.parameters}
        truth = simulate(self.fish.load(), self.controller, parameters)
        warn_of_fin(truth.fin_amplitude)
        return replace(
            optimum,
            true_thrust=truth.mean_thrust,
            relative_thrust=truth.relative_thrust,
            true_power=truth.mean_power,
        )

    def _search_to_draw(self) -> "Search":
        """Return the search over the quantity that is drawn."""
        from fishd.lab.optimise.least_power import LeastPower

        if not isinstance(self.search, LeastPower):
            return self.search
        return self.search.with_observations(
            (t.parameters, t.power, t.power_ci95) for t in self.trials
        )


def _axis_label(aim: "Aim", unit: str) -> str:
    """Return the label of the vertical axis."""
    if aim.target is not None:
        return "power (mW)"
    return f"thrust (m{unit})" if aim.objective == "thrust" else f"thrust per watt (m{unit}/W)"


def _controller_fields() -> dict[str, Field]:
    """Return the parameters of the controller of this command line, by name."""
    types = (param.type for param in click.get_current_context().command.params)
    return {kind.field.name: kind.field for kind in types if isinstance(kind, ParameterType)}


def _take_ranges(
    controller: str, parameters: dict[str, Any], session: "Session"
) -> "tuple[list[Range], dict[str, Any]]":
    """Return the ranges to search, and the other parameters; raises `ParameterError`."""
    from fishd.lab.optimise.trials import make_range

    fields = _controller_fields()
    ranges = {name: value for name, value in parameters.items() if isinstance(value, OpenRange)}
    if not ranges:
        example = next((name for name, field in fields.items() if field.kind == "number"), None)
        if example is None:
            raise click.UsageError(f"{controller} has no numeric parameter that could be searched")
        raise click.UsageError(
            f"no parameter has a range: give one, such as --{example} LOW:HIGH, or "
            f"--{example} : for all that is permitted"
        )
    return (
        [make_range(fields[name], *ends, session) for name, ends in ranges.items()],
        {name: value for name, value in parameters.items() if name not in ranges},
    )


class Optimum(Struct, frozen=True):
    """Result of a search; the fields are those of the JSON output."""

    controller: str
    parameters: dict[str, float]
    parameters_ci95_low: dict[str, float]
    """Lower end of the 95 % interval of each parameter."""
    parameters_ci95_high: dict[str, float]
    """Upper end of that interval."""
    is_measured: bool
    """Whether thrust and power are a measurement of these parameters, not a prediction."""
    thrust: float
    """Thrust with these parameters [N]."""
    thrust_ci95: float
    """Half-width of the 95 % confidence interval of `thrust` [N]."""
    improvement: float
    """Expected improvement by another trial, as a fraction of the objective."""
    trials: int
    swim_ticks: int
    tank_time: float
    """Tank time, rests included [s]."""
    objective: str = "thrust"
    target: float | None = None
    """Thrust to reach [N]; null without --target-thrust."""
    power: float | None = None
    """Electrical power of the servo [W]; null if unknown."""
    power_ci95: float | None = None
    """Half-width of the 95 % confidence interval of `power` [W]."""
    thrust_per_watt: float | None = None
    """Thrust per watt of the servo [N/W]."""
    thrust_per_watt_ci95: float | None = None
    """Half-width of the 95 % confidence interval of `thrust_per_watt` [N/W]."""
    calibration_ci95: float | None = None
    """Half-width of the 95 % interval of the thrust due to the calibration [N].

    null if the uncertainty of the calibration is unknown.
    """
    total_ci95: float | None = None
    """Half-width of the 95 % interval by `thrust_ci95` and `calibration_ci95` together [N]."""
    thrust_per_watt_calibration_ci95: float | None = None
    """Half-width of the 95 % interval of `thrust_per_watt` due to the calibration [N/W]."""
    thrust_per_watt_total_ci95: float | None = None
    """Half-width of the whole 95 % interval of `thrust_per_watt` [N/W]."""
    rotation: float = 0.0
    """Remaining rotation of the sensor's axes after calibration; 0 if none is visible [rad]."""
    choice_time: float | None = None
    """Additional time that a real fish waited for the choice of candidates, this run [s]."""
    true_thrust: float | None = None
    """True thrust of a simulated fish at the best parameters [N]."""
    relative_thrust: float | None = None
    """`true_thrust` divided by the thrust of the best square wave."""
    true_power: float | None = None
    """True power of a simulated servo at the best parameters [W]."""


def _format_trial(
    number: int, trial: "Trial", best: "Proposal | None", unit: str, units: dict[str, str]
) -> str:
    """Return a line about a trial.

    best: the best candidate, or None while too little was measured
    unit: unit of the force; units: units of the parameters
    """
    thrust = text.format_measured(trial.thrust, trial.thrust_ci95, unit)
    kind = ", the best for longer" if trial.is_final else ""
    measured = f"{number}{kind}: {_format_parameters(trial.parameters, units)}: {thrust}"
    if math.isfinite(trial.power):
        measured += f" for {format_power(trial.power)}"
    if best is None or trial.is_final:
        return measured
    more = f"another may give {best.improvement:.1%} more"
    return f"{measured}; best so far {_format_parameters(best.parameters, units)}, {more}"


def _format_parameters(parameters: dict[str, float], units: dict[str, str]) -> str:
    return format_values({name: float(f"{value:.4g}") for name, value in parameters.items()}, units)


def _make_optimum(
    name: str,
    trials: "Sequence[Trial]",
    search: "Search | LeastPower",
    proposal: "Proposal",
    aim: "Aim",
    calibration: "ForceCalibration",
    final: "Trial | None",
) -> Optimum:
    """Return the result of a search.

    calibration: that of the force sensor
    final: measurement of the best candidate; None if there was no time for one, so that thrust and
        power are those that are expected there
    """
    from fishd.lab.error_budget import budget
    from fishd.lab.statistics import per_watt

    last_trial = trials[-1]
    power = power_ci95 = None
    has_power = all(math.isfinite(trial.power) for trial in trials)
    if final:
        parameters, thrust, error = final.parameters, final.thrust, final.thrust_ci95
        if has_power:
            power, power_ci95 = final.power, final.power_ci95
    else:
        parameters = proposal.parameters
        thrusts = [(trial.parameters, trial.thrust, trial.thrust_ci95) for trial in trials]
        thrust, error = search.with_observations(thrusts).predict(parameters)
        if has_power:
            powers = [(trial.parameters, trial.power, trial.power_ci95) for trial in trials]
            power, power_ci95 = search.with_observations(powers).predict(parameters)
    per_watt_value, per_watt_ci95 = per_watt(thrust, error, power, power_ci95)
    rotations = [trial.rotation for trial in trials if trial.rotation]
    rotation = sum(rotations) / len(rotations) if rotations else 0.0
    error_parts = budget(calibration, thrust, error, rotation=rotation)
    per_watt_parts = (
        None
        if per_watt_value is None
        else budget(calibration, per_watt_value, per_watt_ci95, rotation=rotation)
    )
    return Optimum(
        controller=name,
        is_measured=final is not None,
        parameters=parameters,
        parameters_ci95_low=_combine_ends(min, parameters, proposal.parameters_ci95_low),
        parameters_ci95_high=_combine_ends(max, parameters, proposal.parameters_ci95_high),
        thrust=thrust,
        thrust_ci95=error,
        improvement=proposal.improvement,
        trials=len(trials),
        objective=aim.objective if aim.target is None else "least-power",
        target=aim.target,
        power=power,
        power_ci95=power_ci95,
        thrust_per_watt=per_watt_value,
        thrust_per_watt_ci95=per_watt_ci95,
        calibration_ci95=error_parts.calibration_ci95,
        total_ci95=error_parts.total_ci95,
        rotation=rotation,
        thrust_per_watt_calibration_ci95=per_watt_parts and per_watt_parts.calibration_ci95,
        thrust_per_watt_total_ci95=per_watt_parts and per_watt_parts.total_ci95,
        swim_ticks=last_trial.swim_ticks,
        tank_time=last_trial.tank_time,
    )


def _combine_ends(
    choose: Callable[[float, float], float], best: dict[str, float], ends: dict[str, float]
) -> dict[str, float]:
    """Return the ends of intervals, moved so that they include the best values."""
    return {name: choose(best[name], end) for name, end in ends.items()}


def _print_optimum(optimum: Optimum, unit: str, units: dict[str, str]) -> None:
    """Print the result; unit: unit of the force, units: units of the parameters."""
    from fishd.lab import error_budget

    for name, value in optimum.parameters.items():
        symbol = "" if units[name] in ("", "1") else f" {units[name]}"
        interval = (
            f"[{optimum.parameters_ci95_low[name]:.4g}, {optimum.parameters_ci95_high[name]:.4g}]"
        )
        echo(f"best {name} of {optimum.controller}: {value:.4g}{symbol} {interval}")
    thrust = error_budget.format_with_budget(
        optimum.thrust,
        optimum.thrust_ci95,
        optimum.calibration_ci95,
        optimum.total_ci95,
        unit,
        optimum.rotation,
    )
    echo(f"thrust there{'' if optimum.is_measured else ', as expected'}: {thrust}")
    if optimum.power is not None and optimum.power_ci95 is not None:
        per_watt_text = error_budget.format_with_budget(
            optimum.thrust_per_watt or 0.0,
            optimum.thrust_per_watt_ci95 or 0.0,
            optimum.thrust_per_watt_calibration_ci95,
            optimum.thrust_per_watt_total_ci95,
            f"{unit} per W",
        )
        echo(
            f"power there: {text.format_measured(optimum.power, optimum.power_ci95, 'W')}, "
            f"{per_watt_text}"
        )
    if line := error_budget.unknown_calibration(optimum.calibration_ci95, unit):
        echo(f"fishctl: {line}", err=True)
    if optimum.target is not None and optimum.thrust < optimum.target:
        echo(
            f"fishctl: no parameters are known that give {optimum.target * 1e3:g} m{unit}", err=True
        )
    if optimum.true_thrust is not None:
        power_text = (
            "" if optimum.true_power is None else f" for {format_power(optimum.true_power)}"
        )
        echo(
            f"true thrust there: {optimum.true_thrust * 1e3:.2f} mN{power_text}, "
            f"{optimum.relative_thrust:.1%} of the best square wave"
        )
    waiting = (
        ""
        if optimum.choice_time is None
        else f"; {optimum.choice_time:.0f} s of waiting for candidates"
    )
    echo(
        f"{format_count(optimum.trials, 'candidate')}, {optimum.swim_ticks} ticks of swimming, "
        f"{optimum.tank_time:.0f} s including rests{waiting}"
    )
