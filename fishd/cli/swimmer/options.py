"""What the verbs that draw have in common: where their pictures go."""

from pathlib import Path
from typing import Any

import click

from fishd.cli.options import F


def picture_options(function: F) -> F:
    """`--to`, `--form` and `--force`."""
    decorators: tuple[Any, ...] = (
        click.option("--force", is_flag=True, help="Replace files that are there already."),
        click.option(
            "--form",
            type=click.Choice(["png", "svg", "pdf"]),
            default="png",
            show_default=True,
            help="Of the pictures.",
        ),
        click.option(
            "--to",
            "target",
            type=click.Path(path_type=Path, file_okay=False, exists=True),
            default=Path(),
            help="The folder to write to; default: this one.",
        ),
    )
    for decorator in decorators:
        function = decorator(function)
    return function
