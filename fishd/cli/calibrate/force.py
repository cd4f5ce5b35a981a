"""`fishctl calibrate force`: measures known loads or reads them, fits, and saves if confirmed."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import click

from fishd.cli.calibrate import load_files
from fishd.cli.calibrate.force_dialogue import Dialogue
from fishd.cli.calibrate.load_files import NEWTONS
from fishd.cli.options import FiniteRange, endpoint_option, for_option
from fishd.cli.output import echo
from fishd.cli.prompts import choose, input_interrupted
from fishd.client import Fish
from fishd.core import text
from fishd.core.calibration import Z95, ForceCalibration
from fishd.core.errors import FishError
from fishd.hardware.force_sensor.calibration_fit import (
    Fit,
    Load,
    PoorLoads,
    check,
    fit,
    missing_loads,
    worst_load,
)

T = TypeVar("T")

DEFAULT_LOAD_ERROR = 0.01
"""Default of `--load-error`, for kitchen scales, school weights or a pulley with friction."""
_POOR_RESIDUAL = 0.02
"""Residual above which a warning is printed, as a fraction of the largest load."""


@click.command()
@click.option(
    "--unit",
    type=click.Choice(list(NEWTONS)),
    default="N",
    show_default=True,
    help="Unit of the loads: newtons, or grams hung over a pulley.",
)
@for_option("Duration of each measurement [s].", default=5.0, kind=FiniteRange(0.1, 60.0))
@click.option(
    "--load-error",
    "load_ci95",
    type=FiniteRange(0.0, 0.5),
    default=DEFAULT_LOAD_ERROR,
    show_default=True,
    help="Largest error that all loads have in common, as a fraction of a load, such as that of "
    "the scale. No fit can find it; it becomes part of the calibration's uncertainty.",
)
@click.option(
    "--loads",
    "plan",
    type=click.Path(path_type=Path),
    help="CSV file with a plan of loads (columns fx_N,fy_N), or with loads measured "
    "earlier (fx_N,fy_N,vx_V,vy_V), which are fitted at once.",
)
@click.option(
    "--to",
    "record",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write each measured load to this CSV file, which --loads reads.",
)
@click.option("--force", "replace", is_flag=True, help="Replace the file of --to if it exists.")
@click.option("--yes", is_flag=True, help="Save without asking.")
@endpoint_option
def force(
    unit: str,
    seconds: float,
    load_ci95: float,
    plan: Path | None,
    record: Path | None,
    replace: bool,
    yes: bool,
    endpoint: str | None,
) -> int:
    """Calibrate the force sensor with known loads.

    You hang the loads: none at first, then one each along +x, -x, +y and -y, and these four
    again: their differences show how well the gains are known. F_x is positive forward, F_y to
    the fish's left. The daemon measures. Nothing changes before you have seen the fit and
    confirmed it.
    """
    steps = load_files.read(plan, unit) if plan else []
    if steps and (missing := missing_loads([(step.fx, step.fy) for step in steps])):
        raise PoorLoads(f"{plan}: {', '.join(missing)}")
    measured = [Load(step.fx, step.fy, *step.volts) for step in steps if step.volts]
    if measured and record:
        raise click.UsageError(
            f"--to keeps what is measured now, but {plan} holds loads measured earlier; give "
            "one of the two"
        )
    if record:
        load_files.check_new(record, replace=replace)
    with Fish(endpoint) as fish, input_interrupted():
        present = fish.calibrations()  # refused if there is nothing to calibrate
        limit = present.force_limit
        load_files.check_limit(steps, limit)
        try:
            if measured:
                names = [f"load {n}" for n in range(1, len(steps) + 1)]
                fitted = _fit_loads(names, measured, load_ci95)
            else:
                dialogue = Dialogue(fish, unit, seconds, record, limit)
                dialogue.run([(step.fx, step.fy) for step in steps])
                fitted = _fit_with_more_loads(dialogue, load_ci95)
            is_reversed = _request_with_help(fish.status, plan if measured else None).fy_reversed
            if doubt := _explain_doubtful_sign(is_reversed, present.force, fitted.calibration):
                echo(f"warning: {doubt}", err=True)
            is_accepted = yes or click.confirm("Use this calibration from now on, and save it?")
        except (click.Abort, KeyboardInterrupt):
            echo("\nnothing was changed", err=True)
            raise
        if not is_accepted:
            echo("nothing was changed", err=True)
            return 1
        saved = _request_with_help(
            lambda: fish.calibrate_force(fitted.calibration), plan if measured else None
        )
    echo(text.line(f"in use, and saved in {saved.force_file}"))
    return 0


def _request_with_help(ask: Callable[[], T], loads: Path | None) -> T:
    """Return the reply of fishd; after an error, let the operator mend the cause and try again.

    loads: file that holds the loads, for which the error is raised; None if only this process
        holds them
    """
    while True:
        try:
            return ask()
        except FishError as error:
            if loads:
                error.args = (f"{error}; then run this again: the loads are in {loads}",)
                raise
            echo(f"\n{error}\nThe loads are kept", err=True)
            choose("Mend that, then Enter to try again", "")


def _explain_doubtful_sign(
    reversed_now: bool | None, present: ForceCalibration, new: ForceCalibration
) -> str | None:
    """Return why the last motion of the tail contradicts the sign of F_y; None if it does not.

    reversed_now: whether F_y is reversed with the present calibration; None if not known
    """
    same_sign = present.yx * new.yx + present.yy * new.yy > 0.0
    if reversed_now is None or same_sign is not reversed_now:
        return None
    if reversed_now:
        return (
            "F_y is reversed, as the last start of the tail has shown, and this calibration leaves "
            "it reversed: were +y and -y interchanged? If not, the servo turns the wrong way: "
            "'fishctl calibrate servo'"
        )
    return (
        "this calibration reverses F_y, whose sign was right at the last start of the tail: were "
        "+y and -y interchanged?"
    )


def _fit_loads(names: list[str], loads: list[Load], load_ci95: float) -> Fit:
    """Fit the loads and print the quality of the fit; raise `PoorLoads` if it is bad."""
    fitted = fit(loads, load_ci95)
    _print_fit(names, loads, fitted)
    check(fitted, loads, names)
    largest = max(math.hypot(load.fx, load.fy) for load in loads)
    residual = fitted.calibration.residual
    if residual > _POOR_RESIDUAL * largest:
        echo(
            f"warning: the residual is {residual / largest:.0%} of the largest load; look at "
            f"{worst_load(fitted, names)} first",
            err=True,
        )
    return fitted


def _fit_with_more_loads(dialogue: Dialogue, load_ci95: float) -> Fit:
    """Fit the measured loads; while the fit is refused, ask for more loads and keep them all."""
    while True:
        dialogue.amend()
        try:
            return _fit_loads(*dialogue.result(), load_ci95)
        except PoorLoads as error:
            echo(f"\n{error}", err=True)


def _print_fit(names: list[str], loads: list[Load], fitted: Fit) -> None:
    width = max(len("load"), *map(len, names))
    echo(f"\n{'load':<{width}}   F_x [mN]   F_y [mN]     V_x [V]     V_y [V]   errors [mN]")
    for name, load, (ex, ey) in zip(names, loads, fitted.errors, strict=True):
        echo(
            f"{name:<{width}} {load.fx * 1e3:10.2f} {load.fy * 1e3:10.2f} {load.vx:11.5f} "
            f"{load.vy:11.5f} {ex * 1e3:+8.2f} {ey * 1e3:+8.2f}"
        )
    best = fitted.calibration
    echo(f"\nF_x = {best.xx:+.5g} V_x {best.xy:+.5g} V_y {best.x0:+.5g}   [N, V]")
    echo(f"F_y = {best.yx:+.5g} V_x {best.yy:+.5g} V_y {best.y0:+.5g}")
    echo(
        f"residual {best.residual * 1e3:.3f} mN rms over {best.loads} loads, "
        f"condition number {best.condition:.3g}"
    )
    for row, covariance in (
        (("xx", "xy"), best.covariance_x),
        (("yx", "yy"), best.covariance_y),
    ):
        assert covariance is not None  # a fit has one
        first, product, second = covariance
        correlation = product / math.sqrt(first * second) if first * second > 0.0 else 0.0
        echo(
            f"{row[0]} ± {Z95 * math.sqrt(first):.2g}, {row[1]} ± {Z95 * math.sqrt(second):.2g} "
            f"N/V (95 %), correlation {correlation:+.2f}"
        )
    share, load_ci95 = best.thrust_ci95(1.0), best.load_ci95
    assert share is not None
    assert load_ci95 is not None
    scatter = math.sqrt(max(0.0, share**2 - load_ci95**2))
    echo(
        f"a thrust is known to ± {share:.2%}: scatter of the loads ± {scatter:.2%}, "
        f"--load-error ± {load_ci95:.2%}"
    )
