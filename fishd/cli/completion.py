"""What shells complete, and the verb that prints their script.

`complete_…` are for the `shell_complete` of click's parameters.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import click
from click.shell_completion import CompletionItem, get_completion_class

from fishd.core.errors import FishError
from fishd.core.schema import Field

if TYPE_CHECKING:  # with zmq, which most completions do without
    from fishd.client import Fish

_PATIENCE = 1.0
"""How long a key press may wait for a daemon [s]."""


@click.command()
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print the completion script of a shell.

    For bash, put this line into ~/.bashrc: eval "$(fishctl completion bash)"
    """
    root = click.get_current_context().find_root().command
    kind = get_completion_class(shell)
    assert kind is not None
    script = kind(root, {}, "fishctl", "_FISHCTL_COMPLETE").source()
    no_space = "    [[ ${COMPREPLY[0]} == *= ]] && compopt -o nospace\n"  # a value follows `KEY=`
    click.echo(script.replace("    return 0\n", f"{no_space}    return 0\n"))


def endpoint_of(ctx: click.Context) -> str | None:
    """The control socket that the command line names so far, at the verb or before it."""
    found: str | None = ctx.params.get("endpoint") or ctx.find_root().params.get("endpoint")
    return found


def active_parameters(fish: "Fish") -> dict[str, Field]:
    """Those of the active controller, by name."""
    active = fish.status().controller
    infos = (info for info in fish.controllers() if info.name == active)
    return {field.name: field for info in infos for field in info.parameters}


def complete_key(_: click.Context, __: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Keys of the configuration, for `--set KEY=VALUE`."""
    from fishd.config import keys

    every = keys()
    sections = {key.rpartition(".")[0] for key in every}
    return _matching((f"{key}=" for key in every if key not in sections), incomplete)


def complete_pair(
    ctx: click.Context, param: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Names of the parameters of the running controller, and values where there are few."""
    from fishd.client import Fish

    try:
        with Fish(endpoint_of(ctx), timeout=_PATIENCE) as fish:
            fields = active_parameters(fish)
    except FishError:
        return []
    given: tuple[str, ...] = ctx.params.get(param.name or "") or ()
    if len(given) % 2 == 0:
        return _matching(fields, incomplete)
    field = fields.get(given[-1].lstrip("-").replace("-", "_"))
    return complete_value(field, incomplete) if field else []


def complete_contestant(
    _: click.Context, __: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Controllers that need no other program, named policies, and files."""
    from fishd.controllers import registry
    from fishd.controllers.policy import library

    names = [name for name in registry.names() if name != "remote"]
    return _matching([*names, *library.names()], incomplete, files=True)


def complete_policy(_: click.Context, __: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Named policies, and files."""
    from fishd.controllers.policy import library

    return _matching(library.names(), incomplete, files=True)


def complete_value(field: Field, incomplete: str) -> list[CompletionItem]:
    """Values of a parameter: choices, named policies, files; nothing for numbers."""
    if field.kind == "choice":
        return _matching(field.interval.split(" | "), incomplete)
    if field.kind == "boolean":
        return _matching(("true", "false"), incomplete)
    if not field.file:
        return _matching(field.words, incomplete)
    from fishd.controllers.policy import library

    names = library.names() if field.file == library.SUFFIX else []
    return _matching(names, incomplete, files=True)


def _matching(
    words: Iterable[str], incomplete: str, *, files: bool = False
) -> list[CompletionItem]:
    """Those words that begin so. Files come first: bash forgets what was listed before them."""
    begun = [CompletionItem(word) for word in words if word.startswith(incomplete)]
    return [*([CompletionItem(incomplete, type="file")] if files else []), *begun]
