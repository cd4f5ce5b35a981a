"""`fishctl calibrate force`: known loads, measured now or earlier, their fit, and consent."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fishd import text
from fishd.cli import load_files
from fishd.cli.load_dialogue import Dialogue
from fishd.cli.load_files import NEWTONS
from fishd.cli.options import endpoint_option
from fishd.cli.output import echo
from fishd.client import Fish

if TYPE_CHECKING:
    from fishd.calibrating import Fit, Load

_POOR_FIT = 0.02
"""A residual beyond this share of the largest load is worth a warning."""


@click.command()
@click.option(
    "--unit",
    type=click.Choice(list(NEWTONS)),
    default="N",
    show_default=True,
    help="Unit of the loads: newtons, or grams hung over a pulley.",
)
@click.option(
    "--seconds",
    type=click.FloatRange(0.1, 60.0),
    default=5.0,
    show_default=True,
    help="How long to measure each load.",
)
@click.option(
    "--loads",
    "plan",
    type=click.Path(path_type=Path),
    help="CSV with a plan of loads of your own (columns fx_N,fy_N), or with loads measured "
    "earlier (fx_N,fy_N,vx_V,vy_V), which are fitted at once.",
)
@click.option(
    "--record",
    type=click.Path(path_type=Path),
    help="Write each measured load to this CSV file, which --loads reads.",
)
@click.option("--yes", is_flag=True, help="Save without asking.")
@endpoint_option
def force(
    unit: str,
    seconds: float,
    plan: Path | None,
    record: Path | None,
    yes: bool,
    endpoint: str | None,
) -> int:
    """Calibrate the force sensor with known loads: no load, and loads along ±x and ±y.

    F_x is positive forward, F_y to the fish's left. The daemon measures; nothing is changed before
    the fit is shown and you say yes.
    """
    from fishd.calibrating import PoorLoads, missing_loads

    steps = load_files.read(plan, unit) if plan else []
    missing = missing_loads([(step.fx, step.fy) for step in steps])
    if steps and missing:
        raise PoorLoads(f"{plan}: {', '.join(missing)}")
    measured = any(step.volts for step in steps)
    if measured and record:
        raise click.UsageError(
            f"--record keeps what is measured now, but {plan} holds loads measured earlier; give "
            "one of the two"
        )
    with Fish(endpoint) as fish:
        limit = fish.calibrations().force_limit  # refused where there is nothing to calibrate
        load_files.check_limit(steps, limit)
        try:
            if measured:
                names = [f"load {n}" for n in range(1, len(steps) + 1)]
                fitted = _fitted(names, [(s.fx, s.fy, *(s.volts or ())) for s in steps])
            else:
                dialogue = Dialogue(fish, unit, seconds, record, limit)
                dialogue.run([(step.fx, step.fy) for step in steps])
                fitted = _fitted_with_help(dialogue)
            good = yes or click.confirm("Put this calibration in force, and save it?")
        except (click.Abort, KeyboardInterrupt):
            echo("\nnothing was changed", err=True)
            raise
        if not good:
            echo("nothing was changed", err=True)
            return 1
        saved = fish.calibrate_force(fitted.calibration)
    echo(text.line(f"in force, and saved in {saved.force_file}"))
    return 0


def _fitted(names: list[str], loads: list[tuple[float, ...]]) -> "Fit":
    """Fit the loads and show how well that went; raises `PoorLoads`."""
    from fishd.calibrating import Load, check, fit

    known = [Load(*load) for load in loads]
    fitted = fit(known)
    _show(names, known, fitted)
    check(fitted, known, names)
    _warn(names, known, fitted)
    return fitted


def _fitted_with_help(dialogue: Dialogue) -> "Fit":
    """Fit what was measured; while that is no good, ask for more, and keep what there is."""
    from fishd.calibrating import PoorLoads

    while True:
        dialogue.amend()
        try:
            return _fitted(*dialogue.result())
        except PoorLoads as error:
            echo(f"\n{error}", err=True)


def _show(names: list[str], loads: "list[Load]", fitted: "Fit") -> None:
    wide = max(len("load"), *map(len, names))
    echo(f"\n{'load':<{wide}}   F_x [mN]   F_y [mN]     V_x [V]     V_y [V]   errors [mN]")
    for name, load, (ex, ey) in zip(names, loads, fitted.errors, strict=True):
        echo(
            f"{name:<{wide}} {load.fx * 1e3:10.2f} {load.fy * 1e3:10.2f} {load.vx:11.5f} "
            f"{load.vy:11.5f} {ex * 1e3:+8.2f} {ey * 1e3:+8.2f}"
        )
    found = fitted.calibration
    echo(f"\nF_x = {found.xx:+.5g} V_x {found.xy:+.5g} V_y {found.x0:+.5g}   [N, V]")
    echo(f"F_y = {found.yx:+.5g} V_x {found.yy:+.5g} V_y {found.y0:+.5g}")
    echo(
        f"residual {found.residual * 1e3:.3f} mN rms over {found.loads} loads, "
        f"condition number {found.condition:.3g}"
    )


def _warn(names: list[str], loads: "list[Load]", fitted: "Fit") -> None:
    from fishd.calibrating import worst

    largest = max(math.hypot(load.fx, load.fy) for load in loads)
    residual = fitted.calibration.residual
    if residual > _POOR_FIT * largest:
        echo(
            f"warning: the residual is {residual / largest:.0%} of the largest load; look at "
            f"{worst(fitted, names)} first",
            err=True,
        )
