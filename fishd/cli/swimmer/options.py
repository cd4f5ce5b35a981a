"""Common options of the verbs that draw: files and format of the pictures."""

from pathlib import Path
from typing import Any

import click

from fishd.cli.options import F


def picture_options(function: F) -> F:
    """Add `--to`, `--form` and `--force`."""
    decorators: tuple[Any, ...] = (
        click.option("--force", is_flag=True, help="Replace existing files."),
        click.option(
            "--form",
            type=click.Choice(["png", "svg", "pdf"]),
            default="png",
            show_default=True,
            help="Format of the pictures.",
        ),
        click.option(
            "--to",
            "target",
            type=click.Path(path_type=Path, file_okay=False, exists=True),
            default=Path(),
            help="The folder to write to. [default: the current folder]",
        ),
    )
    for decorator in decorators:
        function = decorator(function)
    return function
