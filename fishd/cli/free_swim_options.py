"""Options of `fishctl simulate` that only a free swimmer has: its files."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import click

from fishd.cli.options import F, FiniteRange
from fishd.core import files
from fishd.core.errors import ParameterError

EVERY = 5.0
SETTLE = 8.0
"""From rest to an even speed a swimmer takes about so long [s]."""


class SwimmerOptions(NamedTuple):
    """What they were given."""

    checkpoint: Path | None
    checkpoint_every: float
    resume: Path | None
    save: Path | None
    film: Path | None

    def refuse(self) -> None:
        """Raises `UsageError` where one was given and the fish is no swimmer."""
        for option, path in (
            ("--checkpoint", self.checkpoint),
            ("--resume", self.resume),
            ("--save", self.save),
            ("--film", self.film),
        ):
            if path is not None:
                raise click.UsageError(
                    f"{option} is for robot: swimmer, such as --config config/swimmer.yaml; a "
                    "tethered fish is soon simulated again, and --record keeps its ticks"
                )

    def check(self) -> None:
        """Raises `ParameterError` where a file cannot be written, or should not be."""
        for path in (self.checkpoint, self.save, self.film):
            if path is not None:
                _check(path)
        for option, path in (("--checkpoint", self.checkpoint), ("--resume", self.resume)):
            if path and self.save and _same(path, self.save):
                raise ParameterError(f"{path}: {option} and --save need a file each")
        kept = self.checkpoint
        if kept and os.path.lexists(kept) and not (self.resume and _same(kept, self.resume)):
            raise ParameterError(f"{kept} exists: --resume it, or remove it")


def _check(path: Path) -> None:
    if not path.name:
        raise ParameterError("the name of a file is empty")
    try:
        files.check_writable(path)
    except files.FileProblem as problem:
        raise ParameterError(f"{path}: {problem}") from None


def _same(one: Path, other: Path) -> bool:
    """Whether both names lead to the same file, or would."""
    return one.resolve() == other.resolve() or (
        one.exists() and other.exists() and one.samefile(other)
    )


def swimmer_options(function: F) -> F:
    """`--checkpoint`, `--checkpoint-every`, `--resume`, `--save` and `--film`."""

    def file_option(name: str, about: str) -> Callable[[F], F]:
        kind = click.Path(path_type=Path, dir_okay=False)
        return click.option(name, type=kind, metavar="FILE", help=f"Of a swimmer: {about}")

    decorators: list[Callable[[Any], Any]] = [
        file_option("--film", "paint its wake while it swims: a .webp or .gif file."),
        file_option(
            "--save",
            "write its track, a row for each tick, into this .csv file, or with its midlines into "
            "this .npz file.",
        ),
        file_option(
            "--resume",
            "go on from this checkpoint; with the same controller --seconds is the whole swim, "
            "that before included.",
        ),
        click.option(
            "--checkpoint-every",
            type=FiniteRange(min=0.1),
            default=EVERY,
            show_default=True,
            help="Time of the fish between two checkpoints [s].",
        ),
        file_option("--checkpoint", "keep all that --resume needs in this file, at Ctrl-C, too."),
    ]
    for decorator in decorators:
        function = decorator(function)
    return function
