"""`fishctl doctor`: looks at everything that fishd needs, and says how to mend what is wrong."""

from collections import Counter
from pathlib import Path

import click

from fishd.cli.config import load_service, service_option, set_option
from fishd.cli.doctor.checks import examine
from fishd.cli.doctor.checks.base import Context
from fishd.cli.options import endpoint_option, json_option
from fishd.cli.output import counted, echo, print_json
from fishd.core import text
from fishd.hardware.checks import Result

_COLOURS = {"ok": "green", "warning": "yellow", "FAIL": "red", "skipped": "bright_black"}


@click.command()
@service_option
@set_option
@endpoint_option
@json_option
def doctor(
    file: Path | None, overrides: tuple[str, ...], endpoint: str | None, as_json: bool
) -> int:
    """Check everything that fishd needs with this configuration, and say how to mend it.

    Only what concerns the configured robot is checked. Nothing moves and nothing is changed; a
    running fishd is asked and not disturbed. Exit status 1 when a check failed, 78 when the
    configuration is wrong.
    """
    config, found = load_service(file, overrides)
    context = Context(config, found, endpoint or config.control.address)
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
            f"robot {config.robot}: {counts['ok']} ok, {counted(counts['warning'], 'warning')}, "
            f"{counts['FAIL']} failed, {counts['skipped']} skipped"
        )
        if config.robot == "simulated":
            echo("a simulated fish needs no hardware, so none was checked")
    return 1 if counts["FAIL"] else 0


def _print(name: str, result: Result) -> None:
    level = click.style(f"{result.level:<8}", fg=_COLOURS[result.level])
    click.echo(f"{level} {name:<14} {result.message}")
    if result.mend:
        echo(f"{'':<24}{result.mend}")
