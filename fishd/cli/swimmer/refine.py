"""The verb `fishctl swimmer refine`, which swims a fish on several grids."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import msgspec

from fishd.cli.config import fish_options
from fishd.cli.controller_arguments import ControllerGroup
from fishd.cli.options import F, json_option
from fishd.cli.output import (
    echo,
    echo_rows,
    format_controller,
    format_ratio,
    format_speed,
    print_json,
)
from fishd.cli.swimmer import load_swimmer
from fishd.config import load
from fishd.controllers import registry
from fishd.core import text
from fishd.core.errors import FishdError
from fishd.lab.sweep.grid import Lengths, Point
from fishd.lab.swimmer import refinement
from fishd.lab.swimmer.refinement import Estimate, GridSpeed, Ratio, Refinement
from fishd.lab.swimmer.speed import FROM_REST, swim_freely


def refine_options(function: F) -> F:
    """Add the options of a refinement."""
    for option in (
        json_option,
        fish_options,
        click.option(
            "--settled",
            is_flag=True,
            help="Swim until the speed is steady, which takes some ten times as long. An undamped "
            "body needs it: the error of its speed grows with time.",
        ),
        click.option(
            "--grids",
            type=click.IntRange(2, 3),
            default=3,
            show_default=True,
            help="Number of grids: twice the configured cells, these cells, and half of them, "
            "which takes some six times as long as these.",
        ),
    ):
        function = option(function)
    return function


@click.group(cls=ControllerGroup, options=refine_options)
def refine() -> None:
    """Swim on grids of two or three cell sizes, and estimate the error of the speed.

    The fish starts from rest, and beats 2 to 4 are measured. The error is stored for this fish and
    controller as a fraction of the speed: 'fishctl simulate' and 'fishctl sweep' print it with
    steady speeds, too.

    The ratio of two speeds depends less on the grid. Its error is printed where other gaits of this
    fish swam on the same grids.
    """


@refine.action
def _refine(
    name: str,
    parameters: dict[str, Any],
    grids: int,
    settled: bool,
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
    stored = refinement.load_all()  # raises before the swim
    lengths = Lengths.of(config, None, None) if settled else FROM_REST
    speeds = []
    for fish in fishes:
        numerics = fish.swimmer.numerics
        result = swim_freely(Point(name, parameters), fish, lengths, None)
        assert result
        failure = result.failure
        if not settled and result.beats < lengths.periods:
            failure = f"it beats less than four times in {result.seconds:g} s"
        elif result.speed is not None and result.speed <= 0.0:
            failure = "it does not swim forwards" + ("" if settled else " yet; try --settled")
        if failure or result.speed is None:
            raise FishdError(f"cells of {1e3 * numerics.cell:g} mm: {failure}")
        speeds.append(
            GridSpeed(
                cell=numerics.cell,
                step=numerics.step,
                speed=result.speed,
                speed_ci95=result.speed_ci95 if settled else None,
            )
        )
        if not as_json:
            echo_rows([_format_grid(speeds[-1])])
    swims = Refinement(
        fish=refinement.describe_fish(config),
        controller=name,
        parameters=msgspec.to_builtins(msgspec.structs.asdict(controller.parameters)),
        settled=settled,
        grids=tuple(speeds),
    )
    total = refinement.estimate(speeds)
    ratios = refinement.find_ratios(swims, stored)
    if as_json:
        errors = [total.error(grid.cell) for grid in speeds]
        print_json(
            {"swims": swims, "estimate": total._asdict(), "grid_errors": errors, "ratios": ratios}
        )
    else:
        echo_rows(_describe(swims, total, ratios))
    path = refinement.save(swims)  # after the result is shown: it may fail
    if not as_json:
        echo(path)
    return 0


def _describe(swims: Refinement, total: Estimate, ratios: Sequence[Ratio]) -> list[tuple[str, str]]:
    finest = swims.grids[-1]
    shares = [
        f"± {refinement.relative_error(swims.grids, grid.cell):.0%} on {1e3 * grid.cell:g} mm"
        for grid in swims.grids
    ]
    when = "steady" if swims.settled else "beats 2 to 4 from rest"
    speed = format_speed(finest.speed, finest.speed_ci95, total.error(finest.cell))
    rows = [
        ("controller", format_controller(swims.controller, swims.parameters)),
        ("order", _describe_order(total, len(swims.grids))),
        ("limit", f"{text.format_measured(total.limit, None, 'm/s')} for small cells"),
        ("speed", f"{speed}, {when}"),
        ("by the grid", ", ".join(shares)),
    ]
    for ratio in ratios:
        other = format_controller(ratio.controller, ratio.parameters)
        rows.append(("ratio", f"{format_ratio(ratio.ratio, ratio.grid_error)}, to {other}"))
    return rows


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
