"""How verbs print values."""

from typing import Any

import click
import msgspec


def print_json(value: Any) -> None:
    """Print any struct, or list of them, as one indented JSON document."""
    click.echo(msgspec.json.format(msgspec.json.encode(value), indent=2))


def spelled(parameters: dict[str, Any]) -> str:
    """Parameters as `C=0.6 amplitude=default`."""
    return " ".join(f"{k}={'default' if v is None else v}" for k, v in parameters.items())


def counted(number: int, noun: str) -> str:
    """A number of things: `1 warning`, `2 warnings`."""
    return f"{number} {noun}" + ("" if number == 1 else "s")
