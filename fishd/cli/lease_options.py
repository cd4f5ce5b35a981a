"""The option `--take` of verbs that hold the fish, and the name of their lease."""

from typing import NamedTuple

import click

_KEY = "fishd.take"


def _remember(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    ctx.meta[_KEY] = value


take_option = click.option(
    "--take",
    is_flag=True,
    expose_value=False,
    callback=_remember,
    help="Take the fish from another experiment that holds it; that one ends.",
)


class VerbLease(NamedTuple):
    """How the running verb takes the lease of a fish."""

    experiment: str
    """Name of the lease, such as `measure swing`."""
    take: bool


def verb_lease() -> VerbLease:
    """Return how the verb of this command line, which has `take_option`, takes the lease."""
    context = click.get_current_context()
    _, _, words = context.command_path.partition(" ")
    return VerbLease(words, bool(context.meta.get(_KEY)))
