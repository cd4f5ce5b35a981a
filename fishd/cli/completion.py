"""Completion in shells: the words to complete with, and the verb that prints the script.

The functions `complete_…` are for the `shell_complete` of click's parameters.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import click
from click.shell_completion import CompletionItem, get_completion_class

from fishd.core.errors import FishError
from fishd.core.schema import Field

if TYPE_CHECKING:  # imports zmq, which most completions do not need
    from fishd.client import Fish

_DAEMON_TIMEOUT_S = 1.0
"""Longest time that a key press waits for a daemon [s]."""


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
    """Return the control socket that the command line names, at the verb or before it."""
    endpoint: str | None = ctx.params.get("endpoint") or ctx.find_root().params.get("endpoint")
    return endpoint


def active_parameters(fish: "Fish") -> dict[str, Field]:
    """Return the parameters of the active controller, by name."""
    active = fish.status().controller
    infos = (info for info in fish.controllers() if info.name == active)
    return {field.name: field for info in infos for field in info.parameters}


def complete_key(_: click.Context, __: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return keys of the configuration, for `--set KEY=VALUE`."""
    from fishd.config import keys

    all_keys = keys()
    sections = {key.rpartition(".")[0] for key in all_keys}
    return _match_words((f"{key}=" for key in all_keys if key not in sections), incomplete)


def complete_pair(
    ctx: click.Context, param: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Return names of parameters of the running controller, or the choices for a value."""
    from fishd.client import Fish

    try:
        with Fish(endpoint_of(ctx), timeout=_DAEMON_TIMEOUT_S) as fish:
            fields = active_parameters(fish)
    except FishError:
        return []
    previous_words: tuple[str, ...] = ctx.params.get(param.name or "") or ()
    if len(previous_words) % 2 == 0:
        return _match_words(fields, incomplete)
    field = fields.get(previous_words[-1].lstrip("-").replace("-", "_"))
    return complete_value(field, incomplete) if field else []


def complete_contestant(
    _: click.Context, __: click.Parameter, incomplete: str
) -> list[CompletionItem]:
    """Return controllers that need no other program, named policies, and files."""
    from fishd.controllers import registry
    from fishd.controllers.policy import library

    names = [name for name in registry.names() if name != "remote"]
    return _match_words([*names, *library.names()], incomplete, files=True)


def complete_policy(_: click.Context, __: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return named policies, and files."""
    from fishd.controllers.policy import library

    return _match_words(library.names(), incomplete, files=True)


def complete_value(field: Field, incomplete: str) -> list[CompletionItem]:
    """Return values of a parameter: choices, named policies, files; nothing for numbers."""
    if field.kind == "choice":
        return _match_words(field.choices, incomplete)
    if field.kind == "boolean":
        return _match_words(("true", "false"), incomplete)
    if not field.file:
        return _match_words(field.words, incomplete)
    from fishd.controllers.policy import library

    names = library.names() if field.file == library.SUFFIX else []
    return _match_words(names, incomplete, files=True)


def _match_words(
    words: Iterable[str], incomplete: str, *, files: bool = False
) -> list[CompletionItem]:
    """Return the words that begin with `incomplete`.

    Files come first: bash forgets what is listed before them.
    """
    matches = [CompletionItem(word) for word in words if word.startswith(incomplete)]
    return [*([CompletionItem(incomplete, type="file")] if files else []), *matches]
