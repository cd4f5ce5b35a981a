"""Options of `fishctl simulate` that only a free swimmer has: its files."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import click

from fishd.cli.options import F, FiniteRange
from fishd.core import files
from fishd.core.errors import ParameterError

DEFAULT_CHECKPOINT_INTERVAL_S = 5.0
DEFAULT_SETTLE_S = 8.0
"""Time that a swimmer needs from rest to a steady speed, roughly [s]."""


class SwimmerOptions(NamedTuple):
    """Values of the options that only a free swimmer has."""

    checkpoint: Path | None
    checkpoint_every: float
    resume: Path | None
    save: Path | None
    film: Path | None

    def refuse(self) -> None:
        """Raise `UsageError` if one of them was given; call this for a tethered fish."""
        for option, path in (
            ("--checkpoint", self.checkpoint),
            ("--resume", self.resume),
            ("--save", self.save),
            ("--film", self.film),
        ):
            if path is not None:
                raise click.UsageError(
                    f"{option} is for robot: swimmer, such as --config config/swimmer.yaml; the "
                    "simulation of a tethered fish is short, and --record writes its ticks"
                )

    def check(self) -> None:
        """Raise `ParameterError` if a file cannot or must not be written."""
        for path in (self.checkpoint, self.save, self.film):
            if path is not None:
                _check_writable(path)
        for option, path in (("--checkpoint", self.checkpoint), ("--resume", self.resume)):
            if path and self.save and _is_same_file(path, self.save):
                raise ParameterError(f"{path}: {option} and --save need different files")
        checkpoint = self.checkpoint
        if (
            checkpoint
            and os.path.lexists(checkpoint)
            and not (self.resume and _is_same_file(checkpoint, self.resume))
        ):
            raise ParameterError(f"{checkpoint} exists: --resume it, or remove it")


def _check_writable(path: Path) -> None:
    if not path.name:
        raise ParameterError("the name of a file is empty")
    try:
        files.check_writable(path)
    except files.FileProblem as problem:
        raise ParameterError(f"{path}: {problem}") from None


def _is_same_file(first: Path, second: Path) -> bool:
    """Return whether both paths lead to the same file, existing or not."""
    return first.resolve() == second.resolve() or (
        first.exists() and second.exists() and first.samefile(second)
    )


def swimmer_options(function: F) -> F:
    """Add `--checkpoint`, `--checkpoint-every`, `--resume`, `--save` and `--film`."""

    def file_option(name: str, about: str) -> Callable[[F], F]:
        kind = click.Path(path_type=Path, dir_okay=False)
        return click.option(name, type=kind, metavar="FILE", help=f"For a swimmer: {about}")

    decorators: list[Callable[[Any], Any]] = [
        file_option("--film", "paint its wake while it swims: a .webp or .gif file."),
        file_option(
            "--save",
            "write its track, one row per tick, to this .csv file, or with its midlines to this "
            ".npz file.",
        ),
        file_option(
            "--resume",
            "continue from this checkpoint; with the same controller --seconds is the duration of "
            "the whole swim, including the part before.",
        ),
        click.option(
            "--checkpoint-every",
            type=FiniteRange(min=0.1),
            default=DEFAULT_CHECKPOINT_INTERVAL_S,
            show_default=True,
            help="Simulated time between two checkpoints [s].",
        ),
        file_option("--checkpoint", "write the state for --resume to this file, also at Ctrl-C."),
    ]
    for decorator in decorators:
        function = decorator(function)
    return function
