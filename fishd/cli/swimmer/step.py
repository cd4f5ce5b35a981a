"""The verb `fishctl swimmer step`, which measures natural frequency and damping in water."""

from pathlib import Path

import click

from fishd.cli.config import fish_options
from fishd.cli.options import FiniteRange, json_option
from fishd.cli.output import echo_rows, print_json
from fishd.cli.swimmer import load_swimmer


@click.command()
@click.argument(
    "activations",
    metavar="[ACTIVATION]...",
    nargs=-1,
    type=FiniteRange(min=0.0, max=1.0, min_open=True),
)
@json_option
@fish_options
def step(
    activations: tuple[float, ...], file: Path | None, overrides: tuple[str, ...], as_json: bool
) -> None:
    """Measure natural frequency ω₀ and damping ξ from steps of the muscles in still water.

    ACTIVATION is the height of a step, by default 0.02, 0.2 and 1. ω₀ and ξ are those of the
    paper's oscillator, α̈ + ξω₀α̇ + ω₀²(α − α_c) = 0, fitted to the angle of the tail. Its misfit
    is relative to α_c.
    """
    from fishd.lab.swimmer.step_response import MAX_XI, fit, swim_step

    config = load_swimmer(file, overrides)
    found = []
    for activation in activations or (0.02, 0.2, 1.0):
        found.append(fit(activation, *swim_step(config.swimmer, activation)))
        if not as_json:
            last = found[-1]
            weak = "; such damping shows only ω₀/ξ" if last.xi > MAX_XI else ""
            what = f"ω₀ {last.omega0:.2f} rad/s, ξ {last.xi:.2f}, α_c {last.angle:.4f} rad"
            echo_rows(
                [(f"step of {100 * activation:g} %", f"{what}, misfit {last.misfit:.2%}{weak}")]
            )
    if as_json:
        print_json({"steps": found})
