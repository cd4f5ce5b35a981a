"""Check of an experiment's command line: its verb does all that it does before the fish swims.

What a check writes is in a temporary folder, which is removed.
"""

from collections.abc import Sequence
from contextvars import ContextVar
from tempfile import TemporaryDirectory

import click

from fishd.core.errors import FishdError, NoDaemon

is_active: ContextVar[bool] = ContextVar("is_active", default=False)
"""Whether the verb that runs is only checked."""


class _Checked(Exception):
    """The verb has come to the point at which the fish would swim."""

    def __init__(self, seconds: float | None) -> None:
        super().__init__()
        self.seconds = seconds


def end_of_check(seconds: float | None = None) -> None:
    """End a verb that is only checked; seconds: expected duration of its swims, None if unknown."""
    if is_active.get():
        raise _Checked(seconds)


def check(context: click.Context, words: Sequence[str], address: str) -> float | None:
    """Return the expected duration of an experiment [s]; None if it is not known.

    context: any of the command line that runs
    words: verb and arguments
    address: control socket of the fish; what only its fishd knows is not checked if that is silent
    Raises the errors of the verb.
    """
    fishctl = context.find_root().command
    token = is_active.set(True)
    try:
        with TemporaryDirectory(prefix="fishd-check-") as scratch:
            # The fish may be swimming an experiment now: `--take` refuses none, and takes nothing.
            arguments = ["--endpoint", address, *words, "--take", f"--folder={scratch}/run"]
            fishctl.main(arguments, prog_name="fishctl", standalone_mode=False)
    except _Checked as end:
        return end.seconds
    except NoDaemon:
        return None
    finally:
        is_active.reset(token)
    raise FishdError(f"fishctl {words[0]} would not swim the fish")
