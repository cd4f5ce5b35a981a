"""The verb `fishctl optimise`, which searches the best parameters of a controller."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import click
from msgspec import to_builtins
from msgspec.structs import replace

from fishd.cli.controller_arguments import ParameterType
from fishd.cli.experiment import ChosenFish, ResumableGroup, Run, experiment_options
from fishd.cli.options import FiniteRange, seed_option
from fishd.cli.output import echo, format_count, warn_of_fin
from fishd.cli.progress import format_estimate
from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.core import text
from fishd.core.console import format_power
from fishd.core.errors import ParameterError
from fishd.core.experiments import CurvePoint, Estimate
from fishd.core.schema import Field, format_values, units_of

if TYPE_CHECKING:
    from fishd.lab.optimise.least_power import LeastPower
    from fishd.lab.optimise.result import Optimum
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


optimise_options = experiment_options(
    click.option(
        "--budget",
        type=FiniteRange(min=0.0, min_open=True),
        metavar="SECONDS",
        default=300.0,
        show_default=True,
        help="Largest tank time, rests included [s].",
    ),
    click.option(
        "--min-gain",
        type=FiniteRange(0.0, 1.0),
        default=0.01,
        show_default=True,
        help="Stop once the expected gain of another trial is less than this fraction.",
    ),
    seed_option("the search"),
    click.option(
        "--objective",
        type=click.Choice(["thrust", "thrust-per-watt"]),
        help="What to maximise: thrust, or thrust per watt of the servo's electrical power. "
        "[default: thrust]",
    ),
    click.option(
        "--target-thrust",
        type=FiniteRange(min=0.0, min_open=True),
        metavar="MN",
        help="Thrust to reach [mN]: find the parameters that give it at the least power.",
    ),
    plot="the candidates and what is expected",
    keeps_simulations=True,
)


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
    run: Run,
) -> int:
    from fishd.core.swim_plan import MEAN_REST_S
    from fishd.lab import error_budget
    from fishd.lab.optimise.choice import Choice
    from fishd.lab.optimise.result import make_optimum
    from fishd.lab.optimise.trials import Aim, TrialTable, measure_trials, trial_durations

    if objective and target_thrust:
        raise click.UsageError(
            "--objective and --target-thrust exclude each other: give one of them"
        )
    aim = Aim(objective or "thrust", target_thrust * 1e-3 if target_thrust else None)
    session, fields = run.session(), _controller_fields()
    ranges, fixed = _take_ranges(name, fields, parameters, session)
    search = aim.make_search(ranges, seed)
    _check_ends(name, fixed, ranges, session)
    if budget < (least := 2.0 * MEAN_REST_S + trial_durations(fixed)[1]):
        raise ParameterError(
            f"a budget of {budget:g} s is too short: one candidate takes {least:.3g} s"
        )
    settings = {
        "controller": name,
        "parameters": fixed,
        "ranges": {searched.name: [searched.low, searched.high] for searched in ranges},
        "seed": seed,
        "objective": aim.objective,
        "target": aim.target,
    }
    run.open(settings)
    table = TrialTable(run.experiment, (searched.name for searched in ranges))
    kept = len(table.candidates)
    if kept:
        run.echo(f"{run.folder}: {format_count(kept, 'candidate')} measured already")
    choice = Choice(search, aim, fixed, min_gain)
    trials: list[Trial] = []
    units = units_of(fields.values())
    with run.swimming(budget) as show:
        for trial in measure_trials(session, name, fixed, choice.next, budget, table.candidates):
            trials.append(trial)
            choice.add(trial)
            if len(trials) > kept:
                table.add(trial)
                best = search.propose() if search.is_warm else None
                line = _format_trial(len(trials), trial, best, session.unit, units)
                show.done(line, trial.tank_time, _curve_point(trials, units, session.unit))
                if best:
                    show.estimate(_list_estimates(best, units))
    if not trials:
        run.check("before the first candidate was measured")
        raise ParameterError(f"a budget of {budget:g} s is too short for the first candidate")
    proposal = search.propose()
    optimum = make_optimum(name, trials, choice, proposal, aim, session.calibration)
    if run.fish.on == "live":
        optimum = replace(optimum, choice_time=choice.waited)
    else:
        optimum = _add_truth(optimum, run.fish, fixed)
    estimates = _list_estimates(optimum, units)
    run.show(
        optimum,
        lambda: _print_optimum(optimum, session.unit, units, run.folder),
        kept=to_builtins(optimum) | {"summary": ", ".join(map(format_estimate, estimates))},
        estimates=[*estimates, error_budget.estimate_thrust("thrust there", optimum, session.unit)],
    )
    _draw(run, search, trials, proposal, units, _axis_label(aim, session.unit))
    run.check(f"{format_count(len(trials), 'candidate')} are kept")
    if choice.is_done(proposal):
        return 0
    echo(
        f"fishctl: the budget of {budget:g} s is used up: another candidate is expected to give "
        f"{proposal.improvement:.1%} more, --min-gain is {min_gain:.1%}. "
        f"To continue: {run.experiment.resume_command} --budget SECONDS",
        err=True,
    )
    return 1


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


def _add_truth(optimum: "Optimum", fish: ChosenFish, fixed: dict[str, Any]) -> "Optimum":
    """Return the result with the true values of a simulated fish."""
    from fishd.lab.simulation import simulate

    config = fish.load()
    truth = simulate(config, optimum.controller, {**fixed, **optimum.parameters})
    warn_of_fin(truth.fin_amplitude)
    return replace(
        optimum,
        true_thrust=truth.mean_thrust,
        relative_thrust=truth.relative_thrust if config.kind.is_of_plant() else None,
        true_power=truth.mean_power,
    )


def _draw(
    run: Run,
    search: "Search | LeastPower",
    trials: "Sequence[Trial]",
    proposal: "Proposal",
    units: dict[str, str],
    label: str,
) -> None:
    """Draw the search over the quantity that is drawn; label: of the vertical axis."""
    from fishd.lab.optimise.figure import draw
    from fishd.lab.optimise.least_power import LeastPower

    if isinstance(search, LeastPower):
        search = search.with_observations((t.parameters, t.power, t.power_ci95) for t in trials)
    paths = run.pictures("thrust")
    draw(paths, search, proposal, units, label)
    run.echo_pictures(paths)


def _list_estimates(best: "Proposal | Optimum", units: dict[str, str]) -> list[Estimate]:
    """Return the best parameters with their intervals."""
    low, high = best.parameters_ci95_low, best.parameters_ci95_high
    return [
        Estimate(f"best {name}", value, low[name], high[name], units[name])
        for name, value in best.parameters.items()
    ]


def _curve_point(trials: "Sequence[Trial]", units: dict[str, str], force_unit: str) -> CurvePoint:
    """Return the latest trial, over its parameter if one is searched, else over its number."""
    trial, x, x_name = trials[-1], float(len(trials)), "candidate"
    if len(trial.parameters) == 1:
        ((name, x),) = trial.parameters.items()
        x_name = f"{name} [{units[name]}]"
    return CurvePoint(x, trial.thrust, trial.thrust_ci95, x_name, unit=force_unit)


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
    controller: str, fields: dict[str, Field], parameters: dict[str, Any], session: "Session"
) -> "tuple[list[Range], dict[str, Any]]":
    """Return the ranges to search, and the other parameters; raises `ParameterError`."""
    from fishd.lab.optimise.trials import make_range

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


def _print_optimum(optimum: "Optimum", unit: str, units: dict[str, str], folder: Path) -> None:
    """Print the result; unit: unit of the force, units: units of the parameters."""
    from fishd.lab import error_budget

    for name, value in optimum.parameters.items():
        symbol = "" if units[name] in ("", "1") else f" {units[name]}"
        low, high = optimum.parameters_ci95_low[name], optimum.parameters_ci95_high[name]
        echo(f"best {name} of {optimum.controller}: {value:.4g}{symbol} [{low:.4g}, {high:.4g}]")
    expected = "" if optimum.is_measured else ", as expected"
    echo(f"thrust there{expected}: {error_budget.format_thrust(optimum, unit)}")
    if optimum.power is not None:
        power = text.format_measured(optimum.power, optimum.power_ci95, "W")
        echo(f"power there: {power}, {error_budget.format_per_watt(optimum, unit)}")
    if line := error_budget.warn_of_unknown_calibration(optimum, unit):
        echo(f"fishctl: {line}", err=True)
    if optimum.target is not None and optimum.thrust < optimum.target:
        target = f"{optimum.target * 1e3:g} m{unit}"
        echo(f"fishctl: no parameters are known that give {target}", err=True)
    if optimum.true_thrust is not None:
        power = "" if optimum.true_power is None else f" for {format_power(optimum.true_power)}"
        relative_thrust = optimum.relative_thrust
        share = f", {relative_thrust:.1%} of the best square wave" if relative_thrust else ""
        echo(f"true thrust there: {optimum.true_thrust * 1e3:.2f} mN{power}{share}")
    waiting = ""
    if optimum.choice_time is not None:
        waiting = f"; {optimum.choice_time:.0f} s of waiting for candidates"
    echo(
        f"{format_count(optimum.trials, 'candidate')}, {optimum.swim_ticks} ticks of swimming, "
        f"{optimum.tank_time:.0f} s including rests{waiting}"
    )
    echo(f"table: {folder / 'rows.csv'}")
