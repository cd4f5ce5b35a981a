"""`fishctl doctor`: checks everything that fishd needs, and prints remedies."""

import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import click

from fishd.cli.config import load_service, service_option, set_option
from fishd.cli.doctor import computer, drivers, service, software, timing
from fishd.cli.doctor.base import Context
from fishd.cli.options import endpoint_option, for_option, json_option
from fishd.cli.output import echo, format_count, print_json
from fishd.core import text
from fishd.core.errors import MissingPackage, StartupError, install_command
from fishd.hardware.checks import Check, Result, fail
from fishd.hardware.registry import driver_packages

_COLOURS = {"ok": "green", "warning": "yellow", "FAIL": "red", "skipped": "bright_black"}


@click.command()
@service_option
@set_option
@endpoint_option
@json_option
@click.option(
    "--bench",
    is_flag=True,
    help="Measure this board with two wires and without the servo, and write a report to send.",
)
@click.option("--yes", is_flag=True, help="With --bench: do not ask about the wires.")
@click.option(
    "--loop-gpio",
    type=click.IntRange(0, 27),
    default=23,
    show_default=True,
    help="With --bench: pin that the wire from the servo's pin leads to, Broadcom number.",
)
@for_option("With --bench: length of the swim [s].", default=10.0)
@click.option(
    "--to",
    "output",
    type=click.Path(path_type=Path, file_okay=False),
    metavar="FOLDER",
    default=Path(),
    help="With --bench: folder of the report; default: this one.",
)
def doctor(
    file: Path | None,
    overrides: tuple[str, ...],
    endpoint: str | None,
    as_json: bool,
    bench: bool,
    yes: bool,
    loop_gpio: int,
    seconds: float,
    output: Path,
) -> int:
    """Check everything that fishd needs with this configuration, and print remedies.

    Only what the configured robot needs is checked. Nothing moves and nothing is changed,
    also in a fishd that runs. Exit status 1 when a check failed, 78 when the
    configuration is wrong.

    With --bench, the servo must be unplugged: the pulses of a swim are measured, and their end
    after a kill, the ADC, its bus, and how late ticks come. See docs/how-to/bench.md.
    """
    config, used_file = load_service(file, overrides)
    context = Context(config, used_file, endpoint or config.control.address)
    if bench:
        return _measure_board(context, overrides, loop_gpio, seconds, output, yes, as_json)
    findings = []
    for name, result in examine(context):
        result = result._replace(message=text.line(result.message))
        findings.append({"check": name, **result._asdict()})
        if not as_json:
            _print(name, result)
    counts = Counter(finding["level"] for finding in findings)
    if as_json:
        print_json(findings)
    else:
        echo(
            f"robot {config.robot}: {counts['ok']} ok, "
            f"{format_count(counts['warning'], 'warning')}, {counts['FAIL']} failed, "
            f"{counts['skipped']} skipped"
        )
        if not config.kind.has_hardware:
            echo("a simulated fish needs no hardware, so none was checked")
    return 1 if counts["FAIL"] else 0


def _measure_board(
    context: Context,
    overrides: tuple[str, ...],
    loop_gpio: int,
    seconds: float,
    output: Path,
    yes: bool,
    as_json: bool,
) -> int:
    from fishd.cli.doctor.bench import measurement
    from fishd.cli.doctor.bench.swim import Bench

    measurement.check_wiring(context, loop_gpio)
    if occupied := context.occupied("owns the hardware"):
        raise StartupError(f"{occupied.message}; stop it first, such as: sudo systemctl stop fishd")
    if not yes:
        measurement.confirm(context, loop_gpio)
    return measurement.run(
        Bench(context, overrides, loop_gpio, seconds), output, None if as_json else _print
    )


def _print(name: str, result: Result) -> None:
    level = click.style(f"{result.level:<8}", fg=_COLOURS[result.level])
    click.echo(f"{level} {name:<14} {result.message}")
    if result.remedy:
        echo(f"{'':<24}{result.remedy}")


def checks(context: Context) -> Iterator[Check]:
    """Return the checks for the configured robot, in their order."""
    all_checks = (
        *software.CHECKS,
        *computer.CHECKS,
        *timing.CHECKS,
        *(drivers.checks(context) if context.config.kind.has_hardware else ()),
        *service.CHECKS,
    )
    return (check for check in all_checks if check.applies(context.config.kind))


def examine(context: Context) -> Iterator[tuple[str, Result]]:
    """Run every check for the configured robot; yield its name and result.

    A check that raises an error counts as failed, and the next ones still run.
    """
    for check in checks(context):
        try:
            with driver_packages():
                result = check.function(context)
        except MissingPackage as error:
            is_ours = "fishd[pi]" in str(error)
            remedy = install_command("pi") if is_ours else f"{sys.executable} -m pip install it"
            result = fail(str(error), remedy)
        except Exception as error:
            message = f"this check broke off: {type(error).__name__}: {error}"
            result = fail(message, "please report this, with the output of 'fishctl doctor --json'")
        if result is not None:
            yield check.name, result
