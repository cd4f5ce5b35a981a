"""The verbs about a free swimmer, loaded when they are called (extra: swimmer)."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from fishd.cli.verbs import Verb, Verbs

if TYPE_CHECKING:
    from fishd.config import Config

VERBS = {
    "Measure": {
        "step": Verb("swimmer.step", "step", "Measure natural frequency and damping in water."),
        "refine": Verb("swimmer.refine", "refine", "Estimate the error of its speed by the grid."),
    },
    "Draw": {
        "wake": Verb("swimmer.draw", "wake", "Draw the water around it."),
        "midlines": Verb("swimmer.draw", "midlines", "Draw how its body moves in a beat."),
    },
}


@click.group(cls=Verbs, verbs=VERBS)
def swimmer() -> None:
    """Draw a fish that swims freely: its wake, its midlines; refine its grid.

    'fishctl simulate' swims it and writes the files that these verbs read; 'fishctl sweep'
    measures its speed.
    """


def load_swimmer(file: Path | None, overrides: tuple[str, ...]) -> "Config":
    """Return the configuration of a free swimmer; raise `ParameterError` for another robot."""
    from fishd.config import load
    from fishd.core.errors import ParameterError

    config = load(file, overrides)
    if config.robot != "swimmer":
        raise ParameterError(
            f"robot: {config.robot} has no grid; a swimmer is needed, such as --config "
            "config/swimmer.yaml"
        )
    return config
