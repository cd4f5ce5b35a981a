"""The verb that swims a simulated fish in virtual time."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fishd.cli.config import load_or_exit, set_option
from fishd.cli.options import ControllerGroup, json_option
from fishd.cli.output import echo, print_json, spelled

if TYPE_CHECKING:
    from fishd.simulation import Report


def simulation_options(function: Any) -> Any:
    """The options of a run."""
    for option in reversed(
        (
            click.option(
                "--seconds", type=float, default=60.0, show_default=True, help="Length of the run."
            ),
            click.option(
                "--settle",
                type=float,
                default=10.0,
                show_default=True,
                help="Time before figures are taken [s].",
            ),
            click.option(
                "--config",
                "file",
                type=click.Path(path_type=Path),
                help="YAML file; without it, the defaults.",
            ),
            set_option,
            json_option,
        )
    ):
        function = option(function)
    return function


@click.group(cls=ControllerGroup, options=simulation_options)
def simulate() -> None:
    """Swim a simulated fish in virtual time, with the very loop that runs on the robot."""


@simulate.action
def _simulate(
    name: str,
    parameters: dict[str, Any],
    seconds: float,
    settle: float,
    file: Path | None,
    overrides: tuple[str, ...],
    as_json: bool,
) -> int:
    from fishd.simulation import simulate as run

    report = run(load_or_exit(file, overrides), name, parameters, seconds, settle)
    if as_json:
        print_json(report)
    else:
        echo(_text(report))
    if report.fallback:
        echo(f"fishctl: another controller took over: {report.fallback.message}", err=True)
    if report.reason:
        echo(f"fishctl: the run ended in mode {report.mode}: {report.reason.message}", err=True)
        return 1
    return 0


def _text(report: "Report") -> str:
    best = f"{report.best_square_thrust * 1e3:.3f} mN at {report.best_square_frequency:.3f} Hz"
    rows = [
        ("controller", f"{report.controller} {spelled(report.parameters)}"),
        ("thrust", f"{report.mean_thrust * 1e3:.3f} mN"),
        ("frequency", f"{report.frequency:.3f} Hz"),
        ("fin", f"±{report.fin_amplitude:.4f} rad"),
        (
            "command",
            f"{report.fullness:.1%} of ±{report.amplitude:g} rad on average, "
            f"squareness {report.squareness:.3f}",
        ),
        (
            "efficiency",
            f"{report.efficiency:.1%} of the best square wave at ±{report.amplitude:g} rad",
        ),
        ("", f"({best})"),
        (
            "timing",
            f"{report.ticks} ticks of {report.microseconds_per_tick:.0f} µs, "
            f"{report.real_time_factor:.0f} × real time",
        ),
    ]
    return "\n".join(f"{label:<12}{text}" for label, text in rows)
