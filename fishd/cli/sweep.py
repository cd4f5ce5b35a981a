"""The verb `fishctl sweep`, which measures thrust or speed over a grid of parameters."""

from collections.abc import Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Any

import click
import msgspec
from msgspec.structs import replace

from fishd.cli.controller_arguments import ValuesType
from fishd.cli.experiment import (
    LIVE,
    MEASURED_TAIL,
    SIMULATED,
    ChosenFish,
    ResumableGroup,
    Run,
    experiment_options,
)
from fishd.cli.options import FiniteRange, for_option
from fishd.cli.output import echo, format_count, format_ratio, format_speed, warn_of_fin
from fishd.config import Config
from fishd.controllers.base import Limits
from fishd.core import text
from fishd.core.errors import ConfigError
from fishd.core.experiments import CurvePoint
from fishd.core.process.interruption import Interrupted
from fishd.core.signals import ControllerInfo

if TYPE_CHECKING:
    from fishd.lab.sweep.curves import Best, WholeTicks
    from fishd.lab.sweep.grid import Point
    from fishd.lab.sweep.results import PointResult, Quantity, SweepFolder

DEFAULT_POINT_S = 30.0


sweep_options = experiment_options(
    click.option(
        "--vary",
        multiple=True,
        metavar="KEY=VALUES",
        help="a key of the configuration with several values, such as plant.xi=0.6,1.2,2.4 or "
        "plant.omega0=8:14:2. Repeatable.",
        **SIMULATED,
    ),
    click.option(
        "--settle",
        type=FiniteRange(0.0, 100_000.0),
        help="time before the measured beats [s]. [default: 10; of a free fish 4, or until its "
        "speed is steady]",
        **SIMULATED,
    ),
    click.option(
        "--periods",
        type=click.IntRange(2, 10_000),
        help="measured tail beats of each point; of a free fish, the smallest number. [default: "
        "20; of a free fish 10]",
        **SIMULATED,
    ),
    for_option(f"swimming and resting at each point [s]. [default: {DEFAULT_POINT_S:g}]", **LIVE),
    click.option(
        "--jobs",
        type=click.IntRange(min=1),
        help="number of processes. [default: number of cores]",
        **SIMULATED,
    ),
    click.option(
        "--cluster",
        metavar="ADDRESS",
        help="let the workers of a Dask cluster swim; address of its scheduler, or its file "
        "NAME.json. --resume without it swims on this machine.",
        **SIMULATED,
    ),
    tail=MEASURED_TAIL,
    plot="the curves",
    keeps_simulations=True,
)


@click.group(cls=ResumableGroup, options=sweep_options, remote=True, kind=ValuesType)
def sweep() -> None:
    """Measure thrust over a grid of parameters; write a table, recordings and a picture.

    The speed of a fish that swims freely is measured instead of its thrust.

    CONTROLLER is a controller, or several, such as square,sine,triangle. A parameter takes a
    value, a list such as 1,1.5,2, or a range such as 0.4:4:0.2 (low:high:step). All combinations
    are measured, and the best point is printed. --resume continues an interrupted sweep; its grid
    may then be larger.
    """


@sweep.action
def _sweep(
    infos: list[ControllerInfo],
    parameters: dict[str, list[Any]],
    vary: tuple[str, ...],
    settle: float | None,
    periods: int | None,
    seconds: float | None,
    jobs: int | None,
    cluster: str | None,
    run: Run,
) -> int:
    from fishd.lab.sweep import grid

    names = [info.name for info in infos]
    accepted = {info.name: [field.name for field in info.parameters] for info in infos}
    points = grid.make_points(names, parameters, accepted, _parse_variations(vary))
    if run.fish.on == "live":
        folder = _measure(run, points, DEFAULT_POINT_S if seconds is None else seconds)
    else:
        folder = _swim(run, points, settle, periods, jobs, cluster)
    units = {field.name: field.unit for info in infos for field in info.parameters}
    folder.sort(points)
    _show(run, folder, points, units)
    kept = sum(folder.key(point) in folder.results for point in points)
    run.check(f"{kept} of {format_count(len(points), 'point')} are kept")
    return 1 if any(folder.results[folder.key(point)].failure for point in points) else 0


def _parse_variations(texts: Sequence[str]) -> dict[str, list[Any]]:
    """Return the values of each key; raise `UsageError`."""
    from fishd.lab.sweep.grid import expand_values, parse_value

    variations: dict[str, list[Any]] = {}
    for word in texts:
        key, equals, values = (part.strip() for part in word.partition("="))
        if not (equals and key and values):
            raise click.UsageError(f"--vary {word}: write KEY=VALUES, such as plant.xi=0.6,1.2,2.4")
        if key in variations:
            raise click.UsageError(f"--vary {key} is given twice: write {key}=VALUE,VALUE")
        variations[key] = list(dict.fromkeys(map(parse_value, expand_values(values))))
    return variations


def _swim(
    run: Run,
    points: "list[Point]",
    settle: float | None,
    periods: int | None,
    jobs: int | None,
    cluster: str | None,
) -> "SweepFolder":
    """Swim simulated fish at the points, and return their results."""
    from fishd.lab.sweep.grid import Lengths
    from fishd.lab.sweep.measuring import swim_all

    pairs = _configure_points(run.fish, points)
    lengths = Lengths.of(run.fish.load(), settle, periods)
    run.open({"lengths": msgspec.to_builtins(lengths)}, cluster)
    folder, finished = _open_folder(run, points)
    with run.swimming(len(points), "points") as show:
        show.at(finished)
        with closing(swim_all(folder, pairs, lengths, jobs, cluster)) as results:
            for point, result in results:
                finished += 1
                line = f"{point.label()}: {_format_result(result, folder.quantity)}"
                show.done(line, finished, _curve_point(point, points, result, folder.quantity))
        if finished < len(points):
            raise Interrupted
    return folder


def _measure(run: Run, points: "list[Point]", seconds: float) -> "SweepFolder":
    """Measure a live fish, each point for `seconds`, and return the results."""
    from fishd.core.swim_plan import plan
    from fishd.lab.sweep import grid
    from fishd.lab.sweep.measuring import measure_all

    for point in points:
        plan(seconds, point.parameters)  # raises for too short a time before the fish moves
    session = run.session()
    grid.check_remote(points, Limits(session.amplitude, session.tick))
    run.open({"lengths": {"seconds": seconds}})
    folder, finished = _open_folder(run, points)
    since = finished * seconds
    with run.swimming(len(points) * seconds, since=since, recorded=False) as show:
        for point, result in measure_all(folder, points, session, seconds):
            line = f"{point.label()}: {_format_result(result, folder.quantity)}"
            curve_point = _curve_point(point, points, result, folder.quantity)
            show.done(line, since + session.used, curve_point)
    return folder


def _curve_point(
    point: "Point", points: "Sequence[Point]", result: "PointResult", quantity: "Quantity"
) -> CurvePoint | None:
    """Return a result over the first number that varies; None if it has none, or no result."""
    from fishd.controllers import registry

    units = registry.units(point.controller)
    values = point.columns()
    for name, x in values.items():
        is_number = isinstance(x, int | float) and not isinstance(x, bool)
        if is_number and len({other.columns().get(name) for other in points}) > 1:
            break
    else:
        return None
    if result.value is None:
        return None
    ci95, unit = result.value_ci95, quantity.unit
    series = point.label(without=(name,))
    x_name = name.rpartition(".")[2]
    x_name += f" [{units[x_name]}]" if units.get(x_name, "1") != "1" else ""
    return CurvePoint(x, result.value, ci95, x_name, quantity.name, unit, series)


def _configure_points(fish: ChosenFish, points: "list[Point]") -> "list[tuple[Point, Config]]":
    """Return each point with the configuration of its fish, after checking all points."""
    from fishd.lab.sweep import grid

    configs: dict[tuple[tuple[str, Any], ...], Config] = {}
    for point in points:
        changed = tuple(point.keys.items())
        if changed not in configs:
            configs[changed] = _configure_fish(fish, point)
        grid.check(point, replace(configs[changed].limits, virtual=True))
    return [(point, configs[tuple(point.keys.items())]) for point in points]


def _configure_fish(fish: ChosenFish, point: "Point") -> Config:
    pairs = [f"{key}={value}" for key, value in point.keys.items()]
    try:
        return fish.load(pairs)
    except ConfigError as error:
        message = str(error)
        for pair in pairs:
            message = message.replace(f"--set {pair}", f"--vary {pair}")
        raise ConfigError(message) from None


def _open_folder(run: Run, points: "list[Point]") -> "tuple[SweepFolder, int]":
    """Open the table, and print how many points it already has; return both."""
    from fishd.lab.sweep.results import SweepFolder

    columns = dict.fromkeys(name for point in points for name in point.columns())
    folder = SweepFolder(run.experiment, list(columns))
    finished = sum(folder.key(point) in folder.results for point in points)
    already_measured = f", {finished} of them measured already" if finished else ""
    run.echo(f"{folder.path}: {format_count(len(points), 'point')}{already_measured}")
    return folder, finished


def _show(run: Run, folder: "SweepFolder", points: "list[Point]", units: dict[str, str]) -> None:
    """Print the best points, and draw the curves; units: those of the parameters, by name."""
    from fishd.lab.sweep import curves, figure

    quantity = folder.quantity
    all_curves = curves.make_curves(folder, points)
    bests = [
        (curve, replace(best, whole_ticks=curves.find_best_of_whole_ticks(folder, curve)))
        for curve in all_curves
        if (best := curves.find_best(curve))
    ]

    def print_bests() -> None:
        for curve, best in bests:
            unit = units.get(best.x_name, "")
            echo(f"{curve.label}: {_format_best(best, unit, quantity.unit)}")
            if best.whole_ticks:
                description = _format_whole_ticks(best.whole_ticks, quantity.unit)
                echo(f"{curve.label}, of whole ticks: {description}")
        _echo_grid_errors(run.fish, folder, points)
        echo(f"table: {folder.path / 'rows.csv'}")

    run.show([curves.best_to_builtins(best, quantity) for _, best in bests], print_bests)
    if any(curve.peak for curve in all_curves):
        error_of = "the measurement" if run.fish.on == "live" else "the mean over beats"
        paths = run.pictures(quantity.name)
        figure.draw(paths, all_curves, units, error_of=error_of, quantity=quantity)
        run.echo_pictures(paths)
    fins = [
        (getattr(result, "fin_amplitude", None) or 0.0, point.label())
        for point in points
        if (result := folder.results.get(folder.key(point)))
    ]
    if fins:
        largest, label = max(fins)
        warn_of_fin(largest, f" at {label}")


def _echo_grid_errors(fish: ChosenFish, folder: "SweepFolder", points: "list[Point]") -> None:
    """Print what the grid adds to the errors of speeds, and of their ratios to the fastest."""
    if folder.quantity.name != "speed":
        return
    results = [folder.results.get(folder.key(point)) for point in points]
    errors = [getattr(result, "grid_error", None) for result in results if result]
    known = [error for error in errors if error is not None]
    if known:
        echo(f"by the grid: at most {text.format_half_width(max(known))} mm/s")
    if len(known) < len(errors):
        echo(
            f"by the grid: not known at {len(errors) - len(known)} of "
            f"{format_count(len(errors), 'point')}; 'fishctl swimmer refine' estimates it"
        )
    if len(known) > 1:
        _echo_ratios(fish, folder, points)


def _echo_ratios(fish: ChosenFish, folder: "SweepFolder", points: "list[Point]") -> None:
    """Print the ratios of speeds to the fastest one whose error by the grid is known."""
    from fishd.controllers import registry
    from fishd.lab.swimmer import refinement

    swims = []
    for point, config in _configure_points(fish, points):
        result = folder.results.get(folder.key(point))
        if result and result.value and getattr(result, "grid_error", None) is not None:
            limits = replace(config.limits, virtual=True)
            parameters = registry.check(point.controller, point.parameters, limits)
            values = msgspec.structs.asdict(parameters)
            stored = refinement.find(config, point.controller, values)
            swims.append((result.value, point, config.swimmer.numerics.cell, stored))
    speed, fastest, cell, others = max(swims, key=lambda swim: swim[0])
    for value, point, size, stored in swims:
        share = refinement.ratio_error(stored, others, cell)
        if point is not fastest and size == cell and share is not None:
            ratio = value / speed
            echo(f"{point.label()} / {fastest.label()}: {format_ratio(ratio, abs(ratio) * share)}")


def _format_result(result: "PointResult", quantity: "Quantity") -> str:
    if result.value is None:
        return f"no {quantity.name}: {result.failure}"
    beats = f", {result.beat_frequency:.2f} Hz" if result.beat_frequency else ""
    steady = "" if getattr(result, "settled_time", 0.0) is not None else ", not yet steady"
    value = text.format_measured(result.value, result.value_ci95, quantity.unit)
    if quantity.name == "speed":
        value = format_speed(result.value, result.value_ci95, getattr(result, "grid_error", None))
    if (fin_angle := getattr(result, "fin_angle_max", None)) is not None:
        ci95 = getattr(result, "fin_angle_max_ci95", None)
        steady += f", largest fin angle {text.format_measured(fin_angle, ci95, 'rad')}"
    return f"{value}{beats}{steady}"


def _format_best(best: "Best", unit: str, unit_of_value: str) -> str:
    symbol = "" if unit in ("", "1") else f" {unit}"
    value = text.format_measured(best.value, best.value_ci95, unit_of_value)
    if best.x is None:
        return value
    if "." in best.x_name:  # a property of the fish is not chosen
        return f"largest at {best.x_name} {best.x:.4g}{symbol}: {value}"
    if best.at_edge:
        return (
            f"best measured at {best.x_name} {best.x:g}{symbol}, {value}: at the edge of the grid, "
            "so the best may lie beyond it"
        )
    if best.x_ci95_low is None or best.x_ci95_high is None:
        return f"best measured at {best.x_name} {best.x:.4g}{symbol}: {value}"
    interval = f"[{best.x_ci95_low:.4g}, {best.x_ci95_high:.4g}]"
    return f"best {best.x_name} {best.x:.4g}{symbol} {interval}: {value}"


def _format_whole_ticks(whole_ticks: "WholeTicks", force_unit: str) -> str:
    thrust = text.format_measured(whole_ticks.thrust, whole_ticks.thrust_ci95, force_unit)
    best = f"best measured at {whole_ticks.frequency:.4g} Hz: {thrust}"
    if whole_ticks.nearest_frequency is None:
        return best
    return f"{best}; {whole_ticks.nearest_frequency:.6g} Hz is nearer the best: add it to the grid"
