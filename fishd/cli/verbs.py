"""Groups of verbs: each verb is imported when it is called, and help lists them by purpose."""

import gc
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import click
from click.shell_completion import CompletionItem

from fishd.core.console import complain
from fishd.core.errors import install_command

_EXTRAS = {
    "aiohttp": "window",
    "bayes_opt": "lab",
    "cv2": "camera",
    "distributed": "cluster",
    "gymnasium": "learn",
    "joblib": "lab",
    "matplotlib": "lab",
    "mcap": "record",
    "numba": "swimmer",
    "PIL": "swimmer",
    "onnx": "policy",
    "onnxruntime": "policy",
    "pandas": "lab",
    "pyarrow": "lab",
    "scipy": "lab",
    "segno": "window",
    "simplejpeg": "camera",
    "sklearn": "lab",
    "stable_baselines3": "learn",
    "tensorboard": "learn",
    "torch": "learn",
}
"""Extra of fishd that installs a package, by module name."""


def missing_package(name: str) -> str:
    """Return how to install a package of an extra; empty if it is installed."""
    if find_spec(name):
        return ""
    return f"{name} is not installed; install it with: {install_command(_EXTRAS[name])}"


class Verb(NamedTuple):
    """Location of a verb, and its line of help."""

    module: str
    """Module below fishd.cli."""
    command: str
    """Name of the command in that module."""
    about: str
    """Line of help."""


class Verbs(click.Group):
    """Group that imports a verb when it is called, so that `fishctl status` starts fast."""

    def __init__(
        self,
        *args: Any,
        verbs: Mapping[str, Mapping[str, Verb]],
        daily: Sequence[str] = (),
        word_hints: Mapping[str, str] | None = None,
        **kwargs: Any,
    ) -> None:
        """
        verbs: verbs by heading in help and by name
        daily: names of the verbs that help marks as those for every day
        word_hints: hints for words that are not verbs
        """
        self._sections = verbs
        self._word_hints = word_hints or {}
        self._daily = daily
        self._verbs = {name: verb for section in verbs.values() for name, verb in section.items()}
        # click suggests the nearest of these for a name that is misspelled.
        stubs = {name: click.Command(name) for name in self._verbs}
        super().__init__(*args, **kwargs)
        self.commands.update(stubs)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a verb; if a package of an extra is missing, print one line and exit with 1."""
        try:
            return super().invoke(ctx)
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            if package not in _EXTRAS:
                raise
            complain("fishctl", missing_package(package), 1)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of all verbs, in the order of help."""
        return list(self._verbs)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import and return a verb."""
        verb = self._verbs.get(cmd_name)
        if verb is None:
            return None
        with pause_garbage_collector():
            module = import_module(f"fishd.cli.{verb.module}")
        command: click.Command = getattr(module, verb.command)
        return command

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete the name of a verb without importing any."""
        verbs = self._verbs.items()
        names = [CompletionItem(name, help=verb.about) for name, verb in verbs]
        names = [item for item in names if item.value.startswith(incomplete)]
        return names + click.Command.shell_complete(self, ctx, incomplete)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find a verb; raise `UsageError` with a hint for a word that other programs use."""
        if hint := self._word_hints.get(args[0]):
            raise click.UsageError(f"No such command '{args[0]}': {hint}", ctx)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the verbs below their headings, without importing any."""
        width = max(map(len, self._verbs))
        for heading, section in self._sections.items():
            with formatter.section(heading):
                rows = [
                    (f"{name:<{width}}{' *' if name in self._daily else ''}", verb.about)
                    for name, verb in section.items()
                ]
                formatter.write_dl(rows)
        if self._daily:
            formatter.write_paragraph()
            formatter.write_text("* for every day")


@contextmanager
def pause_garbage_collector() -> Iterator[None]:
    """Pause the garbage collector: in imports it takes a tenth of the time, in drawing a fifth."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
