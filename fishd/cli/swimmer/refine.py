"""The verb `fishctl swimmer refine`, which swims a fish on several grids."""

from pathlib import Path
from typing import Any

import click
import msgspec

from fishd.cli.config import fish_options
from fishd.cli.controller_arguments import ControllerGroup
from fishd.cli.options import F, FiniteRange, json_option
from fishd.cli.output import echo, echo_rows, format_controller, format_speed, print_json
from fishd.cli.swimmer import load_swimmer
from fishd.config import load
from fishd.controllers import registry
from fishd.core import text
from fishd.core.errors import FishdError
from fishd.lab.sweep.grid import Lengths, Point
from fishd.lab.swimmer import refinement
from fishd.lab.swimmer.refinement import Estimate, GridSpeed, Refinement
from fishd.lab.swimmer.speed import swim_freely


def refine_options(function: F) -> F:
    """Add the options of a refinement."""
    for option in (
        json_option,
        fish_options,
        click.option(
            "--settle",
            type=FiniteRange(min=0.0),
            help="Time before the measured beats [s]. [default: 4, or until its speed is steady]",
        ),
        click.option(
            "--periods",
            type=click.IntRange(min=2),
            help="Smallest number of measured beats. [default: 10]",
        ),
        click.option(
            "--grids",
            type=click.IntRange(2, 3),
            default=3,
            show_default=True,
            help="Number of grids: twice the configured cells, these cells, and half of them, "
            "which takes some ten times as long as these.",
        ),
    ):
        function = option(function)
    return function


@click.group(cls=ControllerGroup, options=refine_options)
def refine() -> None:
    """Swim on grids of two or three cell sizes, and estimate the error of the speed.

    The error is stored for this fish and controller, and 'fishctl simulate' and 'fishctl sweep'
    print it with the speed.
    """


@refine.action
def _refine(
    name: str,
    parameters: dict[str, Any],
    grids: int,
    periods: int | None,
    settle: float | None,
    file: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    config = load_swimmer(file, overrides)
    fishes = []
    for cell, step in refinement.choose_grids(config, grids):
        keys = (f"swimmer.numerics.cell={cell:.9g}", f"swimmer.numerics.step={step:.9g}")
        fishes.append(load(file, (*overrides, *keys)))
    controller = registry.create(name, parameters, config.limits)
    values = msgspec.to_builtins(msgspec.structs.asdict(controller.parameters))
    lengths = Lengths.of(config, settle, periods)
    speeds = []
    for fish in fishes:
        numerics = fish.swimmer.numerics
        result = swim_freely(Point(name, parameters), fish, lengths, None)
        assert result
        if result.speed is None:
            raise FishdError(f"cells of {1e3 * numerics.cell:g} mm: {result.failure}")
        speeds.append(
            GridSpeed(
                cell=numerics.cell,
                step=numerics.step,
                speed=result.speed,
                speed_ci95=result.speed_ci95,
            )
        )
        if not as_json:
            echo_rows([_format_grid(speeds[-1])])
    swims = Refinement(
        fish=refinement.describe_fish(config),
        controller=name,
        parameters=values,
        grids=tuple(speeds),
    )
    total = refinement.estimate(swims.grids)
    errors = [total.error(grid.cell) for grid in speeds]
    if as_json:
        print_json({"swims": swims, "estimate": total._asdict(), "grid_errors": errors})
    else:
        finest = speeds[-1]
        echo_rows(
            [
                ("controller", format_controller(name, values)),
                ("order", _describe_order(total, len(speeds))),
                ("limit", f"{text.format_measured(total.limit, None, 'm/s')} for small cells"),
                ("speed", format_speed(finest.speed, finest.speed_ci95, errors[-1])),
            ]
        )
    path = refinement.save(swims)  # after the result is shown: it may fail
    if not as_json:
        echo(path)
    return 0


def _format_grid(grid: GridSpeed) -> tuple[str, str]:
    speed = text.format_measured(grid.speed, grid.speed_ci95, "m/s")
    return f"{1e3 * grid.cell:g} mm", f"{speed}, steps of {1e3 * grid.step:.3g} ms"


def _describe_order(estimate: Estimate, grids: int) -> str:
    if grids == 2:
        return f"{estimate.used_order:g}, assumed: two grids do not show it"
    observed = "none is observed" if estimate.order is None else f"{estimate.order:.2f} observed"
    if estimate.is_converging:
        return observed
    return f"{observed}: not converging yet, so that the error is only a guess; use smaller cells"
