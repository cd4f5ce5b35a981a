"""The verb `fishctl compare`, which compares policies and controllers on the same fish."""

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from msgspec import to_builtins
from msgspec.structs import replace

from fishd.cli.completion import complete_contestant
from fishd.cli.controller_arguments import ControllersCommand
from fishd.cli.experiment import (
    LIVE,
    MEASURED_TAIL,
    SIMULATED,
    Resumable,
    Run,
    experiment_options,
)
from fishd.cli.options import camera_config_option, for_option
from fishd.cli.output import echo, echo_table
from fishd.config import Config, check_tethered
from fishd.core import text
from fishd.core.errors import FishdError, ParameterError, install_command
from fishd.core.experiments import Estimate

if TYPE_CHECKING:
    from rich.table import Table

    from fishd.lab.compare.comparison import Standing, Trace
    from fishd.lab.compare.contestants import Contestant

DEFAULT_RUN_S, DEFAULT_SETTLE_S = 60.0, 10.0
DEFAULT_RUNS = 5
"""Number of runs of each contestant in simulation where runs differ."""


class _Outcome(NamedTuple):
    standings: "list[Standing]"
    traces: "list[Trace]"
    left_out: "list[tuple[Contestant, FishdError, int]]"  # reason, and number of runs before
    amplitude: float  # rad
    unit: str = "N"
    is_random: bool = True  # whether runs depend on the seed
    error: FishdError | None = None  # reason of an early end


class _CompareCommand(ControllersCommand, Resumable):
    """Verb whose arguments are controllers and policies, and that can be resumed."""


@click.command(cls=_CompareCommand)
@click.argument(
    "contestants", nargs=-1, metavar="[POLICY|CONTROLLER]...", shell_complete=complete_contestant
)
@experiment_options(
    click.option(
        "--runs",
        type=click.IntRange(1, 1000),
        help="Runs of each contestant; in simulation, with different noise. "
        f"[default: {DEFAULT_RUNS} in simulation if they differ, else 1]",
    ),
    for_option(
        "Duration of each run [s]; live, with rests.",
        default=DEFAULT_RUN_S,
        kind=click.FLOAT,
    ),
    click.option(
        "--settle",
        type=float,
        help=f"time before the measurement [s]. [default: {DEFAULT_SETTLE_S}]",
        **SIMULATED,
    ),
    click.option(
        "--camera",
        metavar="ADDRESS",
        help="For policies that see pictures, live: request address of fishd-camera. [default: "
        "$FISHD_CAMERA, else that of this machine]",
    ),
    camera_config_option("for policies that see pictures, ", **SIMULATED),
    click.option(
        "--agent",
        metavar="ADDRESS",
        help="for policies that see pictures, on a remote robot: address at which its fishd "
        "reaches this program. [default: any free port of this machine]",
        **LIVE,
    ),
    tail=MEASURED_TAIL,
    plot="command, fin, force and result of each",
)
def compare(
    contestants: tuple[str, ...],
    runs: int | None,
    seconds: float,
    settle: float | None,
    camera: str | None,
    camera_config: str | None,
    agent: str | None,
    run: Run,
) -> int:
    """Compare policies and controllers on the same fish.

    A contestant is the name of a policy (see `fishctl policies`), an .onnx file, or a controller
    with parameters, such as swing:C=0.6 or square --frequency 1.7 --amplitude 0.3. With a list or
    a range of numbers, such as square:frequency=1.2,1.7, each is a contestant. The default is the
    best square wave, swing, and the named policies that are trained for this fish.

    In simulation the thrust is the true thrust, and relative thrust is its ratio to that of the
    best square wave. The thrust of a live fish is measured, with rests between swims; Ctrl-C lets
    the fish rest, and shows the results until then. A policy that sees pictures gets those of a
    simulated camera, or of a running fishd-camera for a live fish. ± is the 95 % interval of the
    mean thrust of all runs. It includes the differences between runs and, live, the error of each
    measurement and of the sensor's calibration, which is the same fraction of all thrusts.
    The verdict names the contestants that may be the best, by intervals that hold together in 95 %
    of cases, and chooses the simplest of them.
    The column |φ_c|/Φ is the mean magnitude of the command. 'square' is this magnitude divided by
    the rms value: 1 for a square wave, 0.900 for a sine, 0.866 for a triangle wave.
    Exit status 1 if this fish refuses a contestant, such as a policy for another amplitude, or if
    a run ends in mode fault; the other contestants are still compared.
    """
    settings = {"for": seconds, "settle": settle}
    if run.fish.on == "live":
        outcome = _measure(run, contestants, settings, runs or 1, camera, agent)
    else:
        outcome = _swim(run, contestants, settings, runs, camera_config or camera)
    status = _report(outcome, runs or 1, run)
    if run.kept_picture and outcome.standings:
        from fishd.lab.compare.figures import draw

        draw(run.kept_picture, outcome.standings, outcome.traces, outcome.amplitude, outcome.unit)
    run.check()
    if outcome.error:
        run.ending.end_verb(str(outcome.error), 1)
    return status


def _swim(
    run: Run,
    texts: tuple[str, ...],
    settings: dict[str, Any],
    runs: int | None,
    camera_file: str | None,
) -> _Outcome:
    """Swim simulated fish, and return their standings."""
    from fishd.camera import settings as cameras
    from fishd.lab.compare import comparison
    from fishd.lab.compare.contestants import is_missing, parse_all, refusal

    config, camera = run.fish.load(), cameras.load_simulated(camera_file)
    check_tethered(config.robot, "compare")
    chosen = parse_all(texts) or _default_contestants(config)
    _check_camera(camera_file, chosen)
    left_out = [
        (contestant, reason) for contestant in chosen if (reason := refusal(config, contestant))
    ]
    for contestant, reason in left_out:
        if len(left_out) == len(chosen) or is_missing(contestant):
            raise reason  # a misspelt path is not a policy for another fish
    refused = [contestant for contestant, _ in left_out]
    accepted = [contestant for contestant in chosen if contestant not in refused]
    seconds, settle = settings["for"], settings["settle"]
    settle = DEFAULT_SETTLE_S if settle is None else settle
    is_random = config.simulation.is_random
    differ = any(comparison.depends_on_seed(contestant, is_random) for contestant in accepted)
    runs = runs or (DEFAULT_RUNS if differ and len(accepted) > 1 else 1)
    run.open(settings | {"contestants": list(map(list, chosen))})
    with run.swimming(len(accepted) * runs * seconds, "s swum") as bar:
        result = comparison.compare(config, accepted, seconds, settle, runs, bar.at, camera)
    run.check("before the end of all runs")
    omitted = [(*pair, 0) for pair in left_out]
    return _Outcome(*result, omitted, config.amplitude_limit, is_random=is_random)


def _measure(
    run: Run,
    texts: tuple[str, ...],
    settings: dict[str, Any],
    runs: int,
    camera: str | None,
    agent: str | None,
) -> _Outcome:
    """Measure a live fish, and return the standings until an error or a signal."""
    from fishd.lab.compare.contestants import absolute, parse_all
    from fishd.lab.compare.live import LiveComparison

    error, seconds = None, settings["for"]
    chosen = list(map(absolute, parse_all(texts)))
    session = run.session(camera=camera, agent=agent)
    chosen = chosen or _default_contestants(session.read_config())
    _check_camera(camera, chosen)
    live = LiveComparison(session, chosen)
    live.check(seconds)  # before the experiment has a folder
    unit = session.unit
    run.open(settings | {"contestants": list(map(list, chosen))})
    try:
        with run.swimming(len(chosen) * runs * seconds) as show:
            live.swim(seconds, runs, lambda: show.estimate(_list_estimates(live.standings(), unit)))
    except ParameterError:
        raise
    except FishdError as reason:  # the runs until then are shown
        error = reason
    return _Outcome(
        live.standings(), live.traces(), live.left_out, session.amplitude, session.unit, True, error
    )


def _check_camera(camera: str | None, chosen: "list[Contestant]") -> None:
    """Raise `UsageError` for a camera if no contestant sees pictures."""
    from fishd.lab.compare.contestants import may_see_pictures

    policies = (
        contestant.parameters.get("policy")
        for contestant in chosen
        if contestant.controller == "ppo"
    )
    if camera is not None and not any(map(may_see_pictures, policies)):
        option = "--camera" if "://" in camera else "--camera-config"
        raise click.UsageError(f"{option} cannot be given here: no contestant sees pictures")


def _default_contestants(config: Config) -> "list[Contestant]":
    """Return the default contestants; print the policies for which a package is missing."""
    from fishd.controllers.policy import library
    from fishd.lab.compare.contestants import default_contestants

    named = library.names()
    if named and not (find_spec("onnx") and find_spec("onnxruntime")):
        echo(
            f"fishctl: left out, as the extra 'policy' is missing: {', '.join(named)}; "
            f"install it with: {install_command('policy')}",
            err=True,
        )
    return default_contestants(config)


def _report(outcome: _Outcome, runs: int, run: Run) -> int:
    """Print the outcome; return the exit status.

    runs: requested runs of each contestant
    """
    from fishd.lab.compare.comparison import judge_standings
    from fishd.lab.error_budget import warn_of_unknown_calibration

    standings = outcome.standings
    verdict = judge_standings(standings, outcome.is_random)
    best = verdict.best if verdict else ()

    def print_table() -> None:
        if not standings:
            return
        echo_table(_make_table(standings, outcome.unit))
        if _are_exact(standings):
            echo("These values have no error: nothing in these runs is random.")
        if sentence := _describe_best_square(standings):
            echo(sentence)
        if verdict:
            echo(headline)

    results = [to_builtins(s) | {"verdict": _verdict_on(s.contestant, best)} for s in standings]
    headline = f"Verdict: {verdict.sentence}." if verdict else ""
    estimates = _list_estimates(standings, outcome.unit)
    run.show(results, print_table, estimates=estimates, headline=headline)
    remarks = []
    measured = [standing for standing in standings if not standing.runs]
    if measured and (line := warn_of_unknown_calibration(measured[0], outcome.unit)):
        remarks.append(line)
    for omitted, reason, completed in outcome.left_out:
        when = f" after {completed} of {runs} runs, which are in the table" if completed else ""
        remarks.append(f"{omitted.label}: left out{when}: {reason}")
    for standing in standings:
        for fallback in standing.fallbacks:
            remarks.append(f"{standing.contestant}: another controller took over: {fallback}")
    faults = [(standing.contestant, fault) for standing in standings for fault in standing.faults]
    remarks += [f"{contestant}: a run ended in mode fault: {fault}" for contestant, fault in faults]
    for remark in remarks:
        echo(f"fishctl: {remark}", err=True)
    return 1 if faults or outcome.left_out else 0


def _list_estimates(standings: "list[Standing]", unit: str) -> list[Estimate]:
    from fishd.lab.error_budget import estimate_thrust

    return [estimate_thrust(standing.contestant, standing, unit) for standing in standings]


def _verdict_on(contestant: str, best: tuple[str, ...]) -> str | None:
    """Return the verdict on a contestant, for JSON; None without a verdict.

    best: contestants that may be the best, the chosen one first
    """
    if not best:
        return None
    if contestant not in best:
        return "loses"
    if len(best) == 1:
        return "wins"
    return "chosen" if contestant == best[0] else "undecided"


def _are_exact(standings: "list[Standing]") -> bool:
    """Return whether all thrusts are without an error."""
    errors = [standing.known_ci95 for standing in standings]
    return all(error is not None and text.format_half_width(error) == "exact" for error in errors)


def _make_table(standings: "list[Standing]", unit: str) -> "Table":
    from rich.table import Table

    from fishd.lab.error_budget import format_fin_angle

    if _are_exact(standings):
        no_errors: dict[str, Any] = dict.fromkeys(
            ("thrust_ci95", "total_ci95", "thrust_per_watt_ci95", "thrust_per_watt_total_ci95")
        )
        standings = [replace(standing, **no_errors) for standing in standings]
    simulated = all(standing.runs for standing in standings)
    table = Table(box=None, pad_edge=False)
    table.add_column("contestant", overflow="fold")
    has_best = all(standing.relative_thrust is not None for standing in standings)
    heads = ["relative"] if has_best else []
    metered = all(standing.thrust_per_watt is not None for standing in standings)
    costs = ["W", f"m{unit}/W"] if metered else []
    parts = [] if simulated else ["statistical", "calibration"]
    fins = [format_fin_angle(standing, unit="") for standing in standings]
    fin_heads = ["fin mrad"] if any(fins) else []
    for head in (*heads, f"m{unit}", *parts, *costs, *fin_heads, "Hz", "|φ_c|/Φ", "square"):
        table.add_column(head, justify="right", no_wrap=True)
    for standing, fin in zip(standings, fins, strict=True):
        cells = [f"{standing.relative_thrust:.1%}"] if has_best else []
        table.add_row(
            standing.contestant,
            *cells,
            text.format_measured(standing.thrust, standing.known_ci95),
            *([] if simulated else _error_cells(standing)),
            *(_power_cells(standing) if metered else []),
            *([fin or "–"] if any(fins) else []),
            f"{standing.frequency:.3f}" if standing.frequency else "–",
            f"{standing.fullness:.3f}",
            f"{standing.form_factor:.3f}",
        )
    return table


def _power_cells(standing: "Standing") -> list[str]:
    """Return the cells of the power and the thrust per watt."""
    half_width = standing.thrust_per_watt_total_ci95
    if half_width is None:
        half_width = standing.thrust_per_watt_ci95
    return [
        f"{standing.power or 0.0:.3f}",
        text.format_measured(standing.thrust_per_watt or 0.0, half_width),
    ]


def _error_cells(standing: "Standing") -> list[str]:
    """Return the cells of the statistical and the calibration error of a thrust."""
    calibration_ci95 = standing.calibration_ci95
    calibration = (
        "unknown" if calibration_ci95 is None else text.format_half_width(calibration_ci95)
    )
    return [text.format_half_width(standing.thrust_ci95 or 0.0), calibration]


def _describe_best_square(standings: "list[Standing]") -> str | None:
    """Return a sentence on the best square wave, if it is the same for all; None on a robot."""
    best = {
        (run.best_square_thrust, run.best_square_frequency)
        for standing in standings
        for run in standing.runs
        if standing.relative_thrust is not None
    }
    if len(best) != 1:
        return None
    ((thrust, frequency),) = best
    return f"The best square wave: {thrust * 1e3:.2f} mN at {frequency:.3f} Hz."
