"""The verb that swims a simulated fish in virtual time."""

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from msgspec.structs import asdict

from fishd.cli.config import fish_options
from fishd.cli.options import for_option, json_option
from fishd.cli.output import (
    echo,
    echo_rows,
    format_controller,
    format_criterion,
    print_json,
    warn_of_fin,
)
from fishd.cli.swimmer.simulation import (
    DEFAULT_SETTLE_S,
    FreeSwimOptions,
    SimulateGroup,
    free_swim_options,
    swim,
)
from fishd.config import Config, load
from fishd.core.console import format_power

if TYPE_CHECKING:
    from fishd.lab.simulation import Report, VirtualRun
    from fishd.recording import RunWriter

_OF_BEST_SQUARE = ("relative_thrust", "best_square_thrust", "best_square_frequency")
"""Fields of a report that depend on the best square wave."""
_ROUNDING_NOTE = (
    "(pigpiod sends pulses in steps of 5 µs, so that the tail swings a little more than ±Φ)"
)


def run_options(function: Any) -> Any:
    """Add the options of a run in virtual time."""
    for option in (
        json_option,
        fish_options,
        click.option(
            "--settle",
            type=float,
            help="Time before measurements begin [s].  [default: 10; 8 if it swims freely]",
        ),
        for_option("Length of the run [s].", default=60.0, kind=click.FLOAT),
    ):
        function = option(function)
    return function


def _simulate_options(function: Any) -> Any:
    record = click.option(
        "--record",
        "recording",
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="FILE",
        help="Record the run into this .mcap file, which must not exist.",
    )
    return run_options(record(free_swim_options(function)))


@click.group(cls=SimulateGroup, options=_simulate_options)
def simulate() -> None:
    """Swim a simulated fish in virtual time, with the loop that runs on the robot."""


@simulate.action
def _simulate(
    name: str,
    parameters: dict[str, Any],
    seconds: float,
    settle: float | None,
    file: Path | None,
    overrides: tuple[str, ...],
    recording: Path | None,
    as_json: bool,
    **free_swims: Any,
) -> int:
    free_swim = FreeSwimOptions(**free_swims)
    from fishd.lab.simulation import check_whole_beat
    from fishd.lab.simulation import simulate as run

    config = load(file, overrides)
    is_free = not config.kind.is_tethered
    if settle is None:
        settle = DEFAULT_SETTLE_S if is_free else 10.0
    with ExitStack() as stack:
        writer, on_start = None, _do_nothing
        if not is_free:
            free_swim.refuse()
        if recording:
            writer = stack.enter_context(_open_recording(recording))
            on_start = partial(_describe, writer, config)
        if is_free:
            run_arguments = (config, name, parameters, seconds, settle, writer, on_start)
            return swim(run_arguments, free_swim, as_json)
        report = run(config, name, parameters, seconds, settle, writer, on_start)
    check_whole_beat(report, seconds, settle)
    has_best = config.kind.is_of_plant()
    if as_json:
        values = asdict(report)
        print_json({key: values[key] for key in values if has_best or key not in _OF_BEST_SQUARE})
    else:
        echo_rows(_rows(report, config, settle, has_best))
    warn_of_fin(report.fin_amplitude)
    if report.fallback:
        echo(f"fishctl: another controller took over: {report.fallback.message}", err=True)
    if report.reason:
        echo(f"fishctl: the run ended in mode {report.mode}: {report.reason.message}", err=True)
        return 1
    return 0


def _do_nothing(_: "VirtualRun") -> None:
    pass


def _describe(writer: "RunWriter", config: Config, run: "VirtualRun") -> None:
    writer.describe(config, run.about(), run.readings)


def _open_recording(path: Path) -> "RunWriter":
    from fishd.recording import RunWriter

    return RunWriter(path, source="simulation")


def _rows(report: "Report", config: Config, settle: float, has_best: bool) -> list[tuple[str, str]]:
    """Return names and values; has_best: whether the best square wave of the fish is known."""
    best = f"{report.best_square_thrust * 1e3:.3f} mN at {report.best_square_frequency:.3f} Hz"
    return [
        (
            "controller",
            f"{format_controller(report.controller, report.parameters)} "
            f"{_format_takeover(report, settle)}".rstrip(),
        ),
        *_criterion_rows(report),
        ("thrust", f"{report.mean_thrust * 1e3:.3f} mN"),
        *_power_rows(report),
        ("frequency", _format_frequency(report, config.tick)),
        ("fin", f"±{report.fin_amplitude:.4f} rad"),
        (
            "command",
            f"{report.fullness:.1%} of ±{report.amplitude:g} rad on average, "
            f"form factor {report.form_factor:.3f}",
        ),
        *(
            [
                (
                    "relative thrust",
                    f"{report.relative_thrust:.1%} of the best square wave at "
                    f"±{report.amplitude:g} rad",
                ),
                ("", f"({best}, where half beats need not be whole ticks)"),
            ]
            if has_best
            else []
        ),
        *([("", _ROUNDING_NOTE)] if config.kind.is_virtual else []),
        (
            "timing",
            f"{report.ticks} ticks of {report.microseconds_per_tick:.0f} µs, "
            f"{report.real_time_factor:.0f} × real time",
        ),
    ]


def _power_rows(report: "Report") -> list[tuple[str, str]]:
    """Return the power into the servo, by its loss model, and the thrust per watt."""
    if not report.mean_power:
        return []
    per_watt = report.mean_thrust * 1e3 / report.mean_power
    return [("power", f"{format_power(report.mean_power)} into the servo: {per_watt:.3g} mN per W")]


def _format_takeover(report: "Report", settle: float) -> str:
    """Return until when the requested controller swam, if another one took over."""
    if report.took_over_at is None:
        return ""
    note = "whose figures these are" if report.took_over_at <= settle else "the figures are of both"
    return f"until {report.took_over_at:.2f} s, then {report.successor}; {note}"


def _criterion_rows(report: "Report") -> list[tuple[str, str]]:
    """Return the C that the controller chose, if that was left to it."""
    if report.parameters.get("C") != "auto" or "criterion" not in report.quantities:
        return []
    return [("", format_criterion(report.quantities, "at the end"))]


def _format_frequency(report: "Report", tick: float) -> str:
    """Return the tail-beat frequency, and the half beats, which are whole ticks."""
    lengths = sorted(set(report.half_beats) - {0})
    if not lengths:
        return "–, as nothing was reversed"
    ticks = " to ".join(map(str, lengths))
    frequencies = " to ".join(f"{0.5 / (length * tick):.3f}" for length in lengths)
    spread = f" ({frequencies} Hz)" if len(lengths) > 1 else ""
    return f"{report.frequency:.3f} Hz, in half beats of {ticks} ticks{spread}"
