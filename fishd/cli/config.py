"""Verbs about the configuration: check a file, show it, print its schema."""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from fishd.cli.completion import complete_key
from fishd.cli.options import F, endpoint_option, json_option
from fishd.cli.output import echo, print_json
from fishd.config import (
    FILE_VARIABLE,
    SERVICE_FILE,
    Config,
    json_schema,
    load,
    mistakes,
    service_file,
    to_yaml,
)
from fishd.core.console import MAX_COMPLAINT
from fishd.core.errors import ConfigError
from fishd.core.schema import fields_of
from fishd.core.text import line
from fishd.hardware.servo import pulses


def _refuse_training(
    _ctx: click.Context, _param: click.Parameter, overrides: tuple[str, ...]
) -> tuple[str, ...]:
    """Say where the settings of a training belong; raises `ConfigError`."""
    of_fish = {field.name for field in fields_of(Config)}
    for override in overrides:
        name = override.partition("=")[0].partition(".")[0].strip()
        if name not in of_fish and name in _of_training():
            raise ConfigError(
                f"--set {override}: --set is about the fish, {name} is a setting of a training: "
                "write it into a YAML file, for 'fishctl learn ppo --settings FILE'"
            )
    return overrides


def _of_training() -> tuple[str, ...]:
    from fishd.learning.settings import TrainingSettings

    return TrainingSettings.__struct_fields__


set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    callback=_refuse_training,
    metavar="KEY=VALUE",
    shell_complete=complete_key,
    help="Override one key of the configuration, such as plant.omega0=10. Repeatable.",
)


def fish_options(function: F) -> F:
    """`--config` and `--set` of verbs that are about a fish of one's own choice."""
    option = config_option("YAML file, as for fishd; without it, the defaults.")
    return option(set_option(function))


def config_option(about: str) -> Callable[[F], F]:
    """`--config`."""
    kind = click.Path(path_type=Path, readable=False)
    return click.option("--config", "file", type=kind, help=about)


service_option = config_option(
    f"YAML file of the daemon; default: ${FILE_VARIABLE}, else {SERVICE_FILE} where there is one, "
    "else the defaults."
)
"""`--config` of verbs that are about the fishd of this machine; goes with `load_service`."""


@click.group()
def config() -> None:
    """Check and show the configuration, print its schema."""


@config.command()
@click.argument("file", type=click.Path(path_type=Path, readable=False))
@set_option
@json_option
def check(file: Path, overrides: tuple[str, ...], as_json: bool) -> None:
    """Check a configuration file, and list all its mistakes.

    Exit status 78 when fishd would refuse it.
    """
    wrong = mistakes.find(file, overrides)
    if as_json:
        print_json({"file": file, "mistakes": wrong})
        sys.exit(os.EX_CONFIG if wrong else 0)
    if wrong:
        for mistake in wrong:
            echo(f"fishctl: {line(' '.join(mistake.split()), MAX_COMPLAINT)}", err=True)
        sys.exit(os.EX_CONFIG)
    loaded = load(file, overrides)
    echo(f"{file}: good")
    left = pulses.cut(loaded.servo, loaded.amplitude_limit)
    if left and loaded.has_hardware:
        echo(f"servo.lowest and servo.highest permit {left}, amplitude_limit")


@config.command()
@click.argument("file", type=click.Path(path_type=Path, readable=False), required=False)
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
        from fishd.client import Fish  # with zmq, which the other forms do without

        with Fish(endpoint) as fish:
            shown: Config | dict[str, Any] = fish.config()
    else:
        shown = load(file, overrides)
    if as_json:
        print_json(shown)
    else:
        echo(to_yaml(shown), nl=False)


@config.command()
def schema() -> None:
    """Print the JSON Schema of the configuration.

    Editors and other programs read it.
    """
    print_json({"$schema": "https://json-schema.org/draft/2020-12/schema"} | json_schema())


def load_service(file: Path | None, overrides: tuple[str, ...]) -> tuple[Config, Path | None]:
    """The configuration of the fishd of this machine, and its file; None for the defaults.

    file: what `--config` says. A file that nobody named is told on standard error.
    """
    if file is None:
        file = service_file()
        if file is not None:
            echo(f"fishctl: using {file}; --config names another file", err=True)
    return load(file, overrides), file
