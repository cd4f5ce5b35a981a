"""Options that verbs share."""

import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import click

from fishd.core import text

F = TypeVar("F", bound=Callable[..., Any])

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


def _choose_endpoint(ctx: click.Context, _: click.Parameter, value: str | None) -> str | None:
    return value or ctx.find_root().obj


endpoint_option = click.option(
    "--endpoint",
    metavar="ADDRESS",
    callback=_choose_endpoint,
    help="Control socket of the daemon; default: $FISHD_ENDPOINT, else the one on this machine.",
)

_TAKE = "fishd.take"


def _store_take(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    ctx.meta[_TAKE] = value


take_option = click.option(
    "--take",
    is_flag=True,
    expose_value=False,
    callback=_store_take,
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
    return VerbLease(words, bool(context.meta.get(_TAKE)))


def for_option(
    about: str,
    *,
    default: float | None = None,
    kind: click.ParamType[Any] | None = None,
    **settings: Any,
) -> Callable[[F], F]:
    """Return the option `--for`, a duration; `--seconds` is another name for it.

    settings: further ones of `click.option`
    """
    return click.option(
        "--for",
        "--seconds",
        "seconds",
        type=kind or FiniteRange(min=0.0, min_open=True),
        metavar="SECONDS",
        default=default,
        show_default=default is not None,
        help=about,
        **settings,
    )


def plot_option(about: str) -> Callable[[F], F]:
    """Return the option `--plot`, the file of a picture; about: what the picture shows."""
    return click.option(
        "--plot",
        "picture",
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="FILE",
        help=f"Draw {about} into this file (.png, .svg, .pdf).",
    )


def tail_option(about: str, **settings: Any) -> Callable[[F], F]:
    """Return the option `--tail`.

    about: what it does with the fin angles of a camera
    settings: further ones of `click.option`
    """
    return click.option(
        "--tail",
        "uses_tail",
        is_flag=True,
        help=f"{about} The camera is that of $FISHD_CAMERA, else that of this machine.",
        **settings,
    )


def seed_option(what: str, default: int | None = 0) -> Callable[[F], F]:
    """Return the option `--seed`; what: what the random numbers are for."""
    return click.option(
        "--seed",
        type=click.IntRange(0, 2**32 - 1),
        default=default,
        show_default=default is not None,
        help=f"Seed of the random number generator of {what}.",
    )


def camera_config_option(scope: str = "", **settings: Any) -> Callable[[F], F]:
    """Return the option `--camera-config`.

    scope: when it can be given; settings: further ones of `click.option`
    """
    return click.option(
        "--camera-config",
        metavar="FILE",
        help=f"{scope}YAML file of a simulated camera, such as config/camera-web.yaml. [default: a "
        "good camera]",
        **settings,
    )


def daemon_options(function: F) -> F:
    """Add `--endpoint` and `--json`."""
    return endpoint_option(json_option(function))


class FiniteRange(click.FloatRange):
    """Finite number within bounds; click's own range also accepts `nan` and `inf`."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Convert a text to a number."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"'{value}' is not valid: a finite number is needed", param, ctx)
        return number


class NamesType(click.ParamType[tuple[str, ...]]):
    """List of names such as `omega0,xi`, as a tuple."""

    name = "names"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, ...]:
        """Convert a text to the names in it."""
        if not isinstance(value, str):
            return tuple(value)
        return tuple(filter(None, value.replace(" ", "").split(",")))


class Utf8Text(click.ParamType[str]):
    """Text in UTF-8, whatever encoding Python assumes for the command line."""

    name = "text"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Convert the bytes of the command line to text."""
        try:
            return value if value.isprintable() else os.fsencode(value).decode()
        except UnicodeError:
            self.fail(f"'{text.quoted(value)}' is not a text in UTF-8", param, ctx)
