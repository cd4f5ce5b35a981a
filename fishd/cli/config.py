"""Verbs about the configuration: check a file, show it, print its schema."""

import itertools
import os
import re
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
from fishd.core.console import MAX_COMPLAINT_CHARACTERS
from fishd.core.errors import ConfigError
from fishd.core.files import shipped_folder, write_atomically
from fishd.core.schema import fields_of, suggest
from fishd.core.text import line
from fishd.hardware.servo import pulses


def _refuse_training(
    _ctx: click.Context, _param: click.Parameter, overrides: tuple[str, ...]
) -> tuple[str, ...]:
    """Raise `ConfigError` for settings of a training, and say where they belong."""
    fish_keys = {field.name for field in fields_of(Config)}
    for override in overrides:
        name = override.partition("=")[0].partition(".")[0].strip()
        if name not in fish_keys and name in _training_keys():
            raise ConfigError(
                f"--set {override}: --set is about the fish, {name} is a setting of a training: "
                "write it into a YAML file, for 'fishctl learn ppo --settings FILE'"
            )
    return overrides


def _training_keys() -> tuple[str, ...]:
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
    """Add `--config` and `--set`, for verbs about a fish that the user chooses."""
    option = config_option("YAML file, as for fishd; without it, the defaults.")
    return option(set_option(function))


def config_option(about: str) -> Callable[[F], F]:
    """Return the option `--config`; about: its help text."""
    kind = click.Path(path_type=Path, readable=False)
    return click.option("--config", "file", type=kind, help=about)


service_option = config_option(
    f"YAML file of the daemon; default: ${FILE_VARIABLE}, else {SERVICE_FILE} where there is one, "
    "else the defaults."
)
"""Option `--config` of verbs about the fishd of this machine, for `load_service`."""


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
    problems = mistakes.find(file, overrides)
    if as_json:
        print_json({"file": file, "mistakes": problems})
        sys.exit(os.EX_CONFIG if problems else 0)
    if problems:
        for mistake in problems:
            echo(f"fishctl: {line(' '.join(mistake.split()), MAX_COMPLAINT_CHARACTERS)}", err=True)
        sys.exit(os.EX_CONFIG)
    loaded = load(file, overrides)
    echo(f"{file}: good")
    permitted = pulses.format_reach(loaded.servo, loaded.amplitude_limit)
    if permitted and loaded.kind.has_hardware:
        echo(f"servo.lowest and servo.highest permit {permitted}, amplitude_limit")


@config.command()
@click.argument("file", type=click.Path(path_type=Path, readable=False), required=False)
@set_option
@click.option("--running", is_flag=True, help="Print what the running fishd was started with.")
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
        from fishd.client import Fish  # imports zmq, which the other forms do not need

        with Fish(endpoint) as fish:
            settings: Config | dict[str, Any] = fish.config()
    else:
        settings = load(file, overrides)
    if as_json:
        print_json(settings)
    else:
        echo(to_yaml(settings), nl=False)


@config.command()
@click.argument("name", required=False)
@click.option(
    "--to",
    "target",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write it into this file.",
)
def example(name: str | None, target: Path | None) -> None:
    """Print an example of a configuration file, or list the examples.

    They are for fishd, for fishd-camera (camera…) and for 'fishctl learn ppo --settings'
    (learning…).
    """
    examples = {path.stem: path.read_text() for path in shipped_folder("config").glob("*.yaml")}
    if name is None:
        if target is not None:
            raise click.UsageError("--to needs the NAME of an example")
        for known in sorted(examples):
            echo(f"{known:<22}{_first_sentence(examples[known])}")
        return
    content = examples.get(name.removesuffix(".yaml"))
    if content is None:
        raise ConfigError(f"no example is named '{name}'; {suggest(name, sorted(examples))}")
    if target is None:
        echo(content, nl=False)
        return
    try:
        write_atomically(target, content, new=True)
    except FileExistsError:
        raise ConfigError(f"{target}: exists already; name another file with --to") from None
    except OSError as error:
        raise ConfigError(f"{target}: cannot be written: {error.strerror}") from None
    echo(f"{target}: written")


def _first_sentence(example: str) -> str:
    """Return the first sentence of the comment at the top of a configuration."""
    comment = itertools.takewhile(lambda row: row.startswith("#"), example.splitlines())
    return re.split(r"(?<=\.)\s(?=[A-Z])", " ".join(row.lstrip("# ") for row in comment))[0]


@config.command()
def schema() -> None:
    """Print the JSON Schema of the configuration.

    Editors and other programs read it.
    """
    print_json({"$schema": "https://json-schema.org/draft/2020-12/schema"} | json_schema())


def load_service(file: Path | None, overrides: tuple[str, ...]) -> tuple[Config, Path | None]:
    """Return the configuration of the fishd of this machine, and its file; None for the defaults.

    file: value of `--config`. Without one, the file that is used is printed on standard error.
    """
    if file is None:
        file = service_file()
        if file is not None:
            echo(f"fishctl: using {file}; --config names another file", err=True)
    return load(file, overrides), file
