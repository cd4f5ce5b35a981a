"""Verbs about the configuration: check a file, show what is in force, print the schema."""

from pathlib import Path
from typing import Any

import click

from fishd.cli.options import endpoint_option, json_option
from fishd.cli.output import echo, print_json
from fishd.client import Fish
from fishd.config import FILE_VARIABLE, SERVICE_FILE, Config, load, service_file, to_yaml
from fishd.console import complain
from fishd.errors import ConfigError
from fishd.hardware import pulses

set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Override one key of the configuration, such as plant.omega0=10. Repeatable.",
)

service_option = click.option(
    "--config",
    "file",
    type=click.Path(path_type=Path),
    help=f"YAML file of the daemon; default: ${FILE_VARIABLE}, else {SERVICE_FILE} where there is "
    "one, else the defaults.",
)
"""`--config` of verbs that are about the fishd of this machine; goes with `load_service`."""

EX_CONFIG = 78


@click.group()
def config() -> None:
    """Check, show and explain the configuration."""


@config.command()
@click.argument("file", type=click.Path(path_type=Path))
@set_option
def check(file: Path, overrides: tuple[str, ...]) -> None:
    """Check a configuration file; exit status 78 when fishd would refuse it."""
    loaded = load_or_exit(file, overrides)
    echo(f"{file}: good")
    left = pulses.cut(loaded.servo, loaded.amplitude_limit)
    if left and loaded.robot != "simulated":
        echo(f"servo.lowest and servo.highest permit {left}, amplitude_limit")


@config.command()
@click.argument("file", type=click.Path(path_type=Path), required=False)
@set_option
@click.option("--running", is_flag=True, help="What the fishd that runs was started with, instead.")
@endpoint_option
@json_option
def show(
    file: Path | None,
    overrides: tuple[str, ...],
    running: bool,
    endpoint: str | None,
    as_json: bool,
) -> None:
    """Print every key with its value in FILE, or its default."""
    if running:
        if file or overrides:
            raise click.UsageError("--running shows what fishd was started with: no FILE, no --set")
        with Fish(endpoint) as fish:
            shown: Config | dict[str, Any] = fish.config()
    else:
        shown = load_or_exit(file, overrides)
    if as_json:
        print_json(shown)
    else:
        echo(to_yaml(shown), nl=False)


@config.command()
def schema() -> None:
    """Print the JSON Schema of the configuration, for editors and other programs."""
    import msgspec

    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    print_json(dialect | msgspec.json.schema(Config))


def load_or_exit(file: Path | None, overrides: tuple[str, ...]) -> Config:
    """The configuration; one line and exit status 78 where it is wrong."""
    try:
        return load(file, overrides)
    except ConfigError as error:
        complain("fishctl", str(error), EX_CONFIG)


def load_service(file: Path | None, overrides: tuple[str, ...]) -> tuple[Config, Path | None]:
    """The configuration of the fishd of this machine, and its file; None for the defaults.

    file: what `--config` says. A file that nobody named is told on standard error.
    """
    if file is None:
        file = service_file()
        if file is not None:
            echo(f"fishctl: using {file}; --config names another file", err=True)
    return load_or_exit(file, overrides), file
