"""The verb that asks the equations for the best command of a fish."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fishd.cli.config import fish_options
from fishd.cli.options import json_option
from fishd.cli.output import echo, echo_rows, print_json, warn_of_fin
from fishd.config import check_tethered, load
from fishd.virtual.plant.parameters import PlantParameters, of_the_paper

if TYPE_CHECKING:
    from fishd.lab.optimum import Optima, OptimalControl

_LARGEST = 1.57
"""As for amplitude_limit [rad]."""
_LEFT_OUT = ("model", "quadratic_drag", "cable_slack", "backlash", "servo_dead_zone")
"""What the closed forms and the optimal control do not know."""


def _checked(
    ctx: click.Context, param: click.Parameter, values: tuple[float, ...]
) -> tuple[float, ...]:
    for value in values:
        if not 0.0 < value <= _LARGEST:  # NaN is not
            raise click.BadParameter(
                f"{value:g} is not valid: a number in (0, {_LARGEST}] is needed"
            )
    return values


@click.command()
@click.option(
    "--amplitude",
    "amplitudes",
    multiple=True,
    type=float,
    callback=_checked,
    help="Φ [rad]; default: amplitude_limit. Repeatable.",
)
@click.option("--control", is_flag=True, help="Find the best command of any shape, too.")
@click.option(
    "--plot",
    "picture",
    type=click.Path(path_type=Path, dir_okay=False),
    help="With --control: draw command, costate and thrust into this file (.png, .svg).",
)
@json_option
@fish_options
def optimum(
    amplitudes: tuple[float, ...],
    control: bool,
    picture: Path | None,
    file: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> None:
    """Show the command that thrusts most, by the equations of the simulated fish.

    Shown are the square wave of the best frequency, and the limits of a servo that is fast (the
    wheel follows at once) and slow (it always turns at full speed); Φ_s separates the two. With
    --control, optimal control finds the best periodic command within ±Φ without being told its
    shape: some seconds.
    """
    from fishd.lab import drawing
    from fishd.lab import optimum as lab

    config = load(file, overrides)
    check_tethered(config.robot, "optimum")
    plant = config.plant
    chosen = amplitudes or (config.amplitude_limit,)
    if control and len(chosen) > 1:
        raise click.UsageError("--control takes one --amplitude at a time")
    if picture and not control:
        raise click.UsageError("--plot draws what --control finds: give both")
    if picture:
        drawing.check(picture)
    best = lab.best_square_waves(plant, chosen)
    fast, slow = lab.fast_servo(plant, chosen), lab.slow_servo(plant, chosen)
    limit = lab.saturation_amplitude(plant)
    found = lab.optimal_control(plant, chosen[0]) if control else None
    for k, amplitude in enumerate(chosen):
        warn_of_fin(best.fin_amplitude[k], f" at ±{amplitude:g} rad")
    if as_json:
        sets = {"best_square": best, "fast_servo": fast, "slow_servo": slow}
        print_json(
            {name: _plain(vars(each)) for name, each in sets.items()}
            | {"saturation_amplitude": limit}
            | ({"optimal_control": _plain(vars(found))} if found else {})
        )
    else:
        for k, amplitude in enumerate(chosen):
            echo_rows(
                [
                    ("amplitude", f"±{amplitude:g} rad, {amplitude / limit:.2f} of Φ_s = Ω/ω₀"),
                    ("best square", _row(best, k)),
                    ("fast servo", _row(fast, k)),
                    ("slow servo", _row(slow, k)),
                ]
            )
        if found:
            echo_rows(_control_rows(found))
        _say_what_is_left_out(plant, control)
    if found and picture:
        from fishd.lab.optimum.figure import draw

        draw(found, picture)


def _row(optima: "Optima", k: int) -> str:
    return (
        f"{1e3 * optima.thrust[k]:.3f} mN at {optima.frequency[k]:.3f} Hz, "
        f"fin ±{optima.fin_amplitude[k]:.4f} rad"
    )


def _control_rows(found: "OptimalControl") -> list[tuple[str, str]]:
    return [
        ("control", f"{1e3 * found.thrust:.3f} mN at {found.frequency:.3f} Hz"),
        ("", f"{found.ratio:.2%} of the best square wave"),
        ("", f"|φ_c| = Φ in {found.full:.1%} of the time"),
        ("", f"on the side of the costate in {found.agreement:.1%} of the time"),
    ]


def _say_what_is_left_out(plant: PlantParameters, control: bool) -> None:
    ideal = of_the_paper(plant)
    left_out = [
        f"plant.{name}" for name in _LEFT_OUT if getattr(plant, name) != getattr(ideal, name)
    ]
    if left_out:
        who = "the limits and the optimal control leave" if control else "the limits leave"
        echo(f"fishctl: {who} out {', '.join(left_out)}", err=True)


def _plain(value: Any) -> Any:
    """Without numpy."""
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    return value.tolist() if hasattr(value, "tolist") else value
