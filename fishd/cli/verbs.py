"""Groups of verbs: each verb is imported only when it is called, help lists them by purpose."""

import gc
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any, NamedTuple

import click
from click.shell_completion import CompletionItem

from fishd.core.console import complain

_EXTRAS = {
    "aiohttp": "camera",
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
    "plotly": "lab",
    "pyarrow": "lab",
    "scipy": "lab",
    "simplejpeg": "camera",
    "sklearn": "lab",
    "stable_baselines3": "learn",
    "tensorboard": "learn",
    "torch": "learn",
}
"""The extra that brings a package."""


class Verb(NamedTuple):
    """Where a verb is, and what it is for."""

    module: str
    """In fishd.cli."""
    command: str
    """In that module."""
    about: str
    """One line of help."""


class Verbs(click.Group):
    """So that `fishctl status` does not wait for what others need."""

    def __init__(
        self,
        *args: Any,
        verbs: Mapping[str, Mapping[str, Verb]],
        daily: Sequence[str] = (),
        other_words: Mapping[str, str] | None = None,
        **kwargs: Any,
    ) -> None:
        """
        verbs: by the heading in help that they stand below, and by name
        daily: those that help marks as verbs for every day
        other_words: what is meant by words that are not verbs
        """
        self._sections = verbs
        self._other_words = other_words or {}
        self._daily = daily
        self._verbs = {name: verb for section in verbs.values() for name, verb in section.items()}
        # click suggests the nearest of these for a name that is misspelled.
        stubs = {name: click.Command(name) for name in self._verbs}
        super().__init__(*args, **kwargs)
        self.commands.update(stubs)

    def invoke(self, ctx: click.Context) -> Any:
        """Run a verb; a package of an extra that is missing is one line."""
        try:
            return super().invoke(ctx)
        except ModuleNotFoundError as error:
            package = (error.name or "").partition(".")[0]
            if package not in _EXTRAS:
                raise
            complain(
                "fishctl",
                f"{package} is not installed; where the sources of fishd are: pip install "
                f"--constraint tools/constraints.txt --editable '.[{_EXTRAS[package]}]'",
                1,
            )

    def list_commands(self, ctx: click.Context) -> list[str]:
        """All verbs, in the order of help."""
        return list(self._verbs)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a verb."""
        verb = self._verbs.get(cmd_name)
        if verb is None:
            return None
        with _no_garbage():
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
        """Find a verb; a word that another program would have for one gets what is meant."""
        if meant := self._other_words.get(args[0]):
            raise click.UsageError(f"No such command '{args[0]}': {meant}", ctx)
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
def _no_garbage() -> Iterator[None]:
    """Nothing that is loaded is garbage: to look for it takes a tenth of the time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()
