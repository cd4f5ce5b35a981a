"""The verb `fishctl optimum`, which computes the best command of a fish from its equations."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fishd.cli.config import fish_options
from fishd.cli.options import json_option, plot_option
from fishd.cli.output import echo, echo_rows, print_json, warn_of_fin
from fishd.config import check_tethered, load
from fishd.virtual.plant.parameters import PlantParameters, without_extensions

if TYPE_CHECKING:
    from fishd.lab.optimum import Optima, OptimalControl

_MAX_AMPLITUDE = 1.57
"""Largest amplitude, as for amplitude_limit [rad]."""
_IGNORED_PARAMETERS = (
    *("model", "servo_law", "quadratic_drag", "cable_slack", "backlash", "servo_dead_zone"),
)
"""Parameters that the closed forms and the optimal control ignore."""


def _check_amplitudes(
    ctx: click.Context, param: click.Parameter, values: tuple[float, ...]
) -> tuple[float, ...]:
    for value in values:
        if not 0.0 < value <= _MAX_AMPLITUDE:  # NaN is not
            raise click.BadParameter(
                f"{value:g} is not valid: a number in (0, {_MAX_AMPLITUDE}] is needed"
            )
    return values


@click.command()
@click.option(
    "--amplitude",
    "amplitudes",
    multiple=True,
    type=float,
    callback=_check_amplitudes,
    help="Φ [rad]; default: amplitude_limit. Repeatable.",
)
@click.option(
    "--any-shape",
    is_flag=True,
    help="Find the best command of any shape, too.",
)
@plot_option("command, costate and thrust of --any-shape")
@json_option
@fish_options
def optimum(
    amplitudes: tuple[float, ...],
    any_shape: bool,
    picture: Path | None,
    file: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> None:
    """Show the command of the largest thrust, by the equations of the simulated fish.

    Prints the square wave of the best frequency, and its limits for a fast servo (the wheel
    follows at once) and a slow one (the wheel always turns at full speed); Φ_s separates the two.
    --any-shape computes the best periodic command of any shape within ±Φ, which takes some seconds.
    """
    from fishd.lab import drawing
    from fishd.lab import optimum as lab

    config = load(file, overrides)
    check_tethered(config.robot, "optimum")
    plant = config.plant
    angles = amplitudes or (config.amplitude_limit,)
    if any_shape and len(angles) > 1:
        raise click.UsageError("--any-shape takes one --amplitude at a time")
    if picture and not any_shape:
        raise click.UsageError("--plot draws what --any-shape finds: give both")
    if picture:
        drawing.check(picture)
    best = lab.best_square_waves(plant, angles)
    fast, slow = lab.fast_servo(plant, angles), lab.slow_servo(plant, angles)
    limit = lab.saturation_amplitude(plant)
    best_control = lab.optimal_control(plant, angles[0]) if any_shape else None
    for k, amplitude in enumerate(angles):
        warn_of_fin(best.fin_amplitude[k], f" at ±{amplitude:g} rad")
    if as_json:
        sets = {"best_square": best, "fast_servo": fast, "slow_servo": slow}
        print_json(
            {name: _to_plain(vars(optima)) for name, optima in sets.items()}
            | {"saturation_amplitude": limit}
            | ({"optimal_control": _to_plain(vars(best_control))} if best_control else {})
        )
    else:
        for k, amplitude in enumerate(angles):
            echo_rows(
                [
                    ("amplitude", f"±{amplitude:g} rad, {amplitude / limit:.2f} of Φ_s = Ω/ω₀"),
                    ("best square", _format_optimum(best, k)),
                    ("fast servo", _format_optimum(fast, k)),
                    ("slow servo", _format_optimum(slow, k)),
                ]
            )
        if best_control:
            echo_rows(_control_rows(best_control))
        _print_ignored(plant, any_shape)
    if best_control and picture:
        from fishd.lab.optimum.figure import draw

        draw(best_control, picture)


def _format_optimum(optima: "Optima", k: int) -> str:
    return (
        f"{1e3 * optima.thrust[k]:.3f} mN at {optima.frequency[k]:.3f} Hz, "
        f"fin ±{optima.fin_amplitude[k]:.4f} rad"
    )


def _control_rows(control: "OptimalControl") -> list[tuple[str, str]]:
    return [
        ("control", f"{1e3 * control.thrust:.3f} mN at {control.frequency:.3f} Hz"),
        ("", f"{control.ratio:.2%} of the best square wave of the same equations"),
        ("", f"|φ_c| = Φ in {control.saturated_fraction:.1%} of the time"),
        ("", f"on the side of the costate in {control.costate_agreement:.1%} of the time"),
    ]


def _print_ignored(plant: PlantParameters, any_shape: bool) -> None:
    ideal = without_extensions(plant)
    left_out = [
        f"plant.{name}"
        for name in _IGNORED_PARAMETERS
        if getattr(plant, name) != getattr(ideal, name)
    ]
    if left_out:
        subject = "the limits and the optimal control leave" if any_shape else "the limits leave"
        echo(f"fishctl: {subject} out {', '.join(left_out)}", err=True)


def _to_plain(value: Any) -> Any:
    """Return the value with arrays and numpy numbers as plain data."""
    if isinstance(value, dict):
        return {name: _to_plain(part) for name, part in value.items()}
    return value.tolist() if hasattr(value, "tolist") else value
