"""How verbs print values: nothing that a daemon or a file says reaches the terminal as it is."""

import re
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
import msgspec

from fishd.core import text
from fishd.core.console import lose_output, why_not_written
from fishd.core.schema import format_values
from fishd.core.signals import Reason

if TYPE_CHECKING:
    from fishd.core.protocol import State

T = TypeVar("T")

_MOST = 1_000_000
"""Longer output than any verb's [characters]."""


def echo(message: Any = "", *, err: bool = False, nl: bool = True) -> None:
    """Print lines without any control character in them, on standard error where wanted."""
    click.echo(text.block(str(message), _MOST), err=err, nl=nl)


@contextmanager
def output_may_fail(done: str) -> Iterator[None]:
    """Let what is printed be lost where it cannot be written, and say so, with what was done.

    For verbs whose exit status tells of the servo.
    """
    try:
        yield
    except OSError as error:
        lose_output()
        with suppress(OSError):
            echo(f"fishctl: {done}; {why_not_written(error)}", err=True)


def echo_rows(rows: Sequence[tuple[str, str]]) -> None:
    """Print what each thing is called, and what it is, in two columns."""
    width = max(12, *(len(name) + 1 for name, _ in rows))
    echo("\n".join(f"{name:<{width}}{what}" for name, what in rows))


def print_json(value: Any) -> None:
    """Print any struct, or list of them, as one indented JSON document."""
    click.echo(_escaped(msgspec.json.format(msgspec.json.encode(value), indent=2)))


def print_paths(paths: Iterable[Path], as_json: bool) -> None:
    """Print the files that a verb has written, a line each or as a list."""
    if as_json:
        print_json([str(path) for path in paths])
    else:
        for path in paths:
            echo(path)


def print_json_line(value: Any) -> None:
    """Print any struct as one line of JSON."""
    click.echo(_escaped(msgspec.json.encode(value)))


def made_printable(value: T) -> T:
    """A struct, or a list of them, with all its texts in one printable line each."""
    return msgspec.convert(_printable(msgspec.to_builtins(value)), type(value))


def spelled(controller: str, parameters: dict[str, Any]) -> str:
    """Return a controller with its parameters, as `square frequency=1.7 Hz amplitude=default`."""
    if not parameters:
        return text.line(controller)
    from fishd.controllers import registry  # as long as all else that most verbs load

    return text.line(f"{controller} {format_values(parameters, registry.units(controller))}")


def state_line(state: "State") -> str:
    """Return mode, reason and controller."""
    state = made_printable(state)
    why = f" ({format_reason(state.reason)})" if state.reason else ""
    return f"{state.mode}{why}: {spelled(state.controller, state.parameters)}"


def format_reason(reason: Reason) -> str:
    """Return the reason of a mode, with its code where that says more."""
    return reason.message if reason.code == "estop" else f"{reason.code}: {reason.message}"


def measured(quantities: dict[str, float], units: dict[str, str]) -> list[tuple[str, str]]:
    """Names of quantities, and their values with units: `("top_speed", "2.31")`."""
    spelled = []
    for name, value in quantities.items():
        unit = text.quoted(units.get(name, "1"))
        spelled.append((text.quoted(name), f"{value:.3g}" + (f" {unit}" if unit != "1" else "")))
    return spelled


def counted(number: int, noun: str) -> str:
    """A number of things: `1 warning`, `2 warnings`."""
    return f"{number} {noun}" + ("" if number == 1 else "s")


def warn_of_fin(amplitude: float, where: str = "") -> None:
    """Say so where a simulated fin swings further than its equations hold.

    amplitude: largest fin angle [rad]; where: that it does
    """
    from fishd.virtual.plant.parameters import LARGEST_FIN

    if amplitude > LARGEST_FIN:
        echo(
            f"fishctl: the fin swings by ±{amplitude:.2f} rad{where}: beyond {LARGEST_FIN:g} rad "
            "the equations of the fish do not hold, nor does this thrust",
            err=True,
        )


def time_of_day(t: float) -> str:
    """Of unix time [s], here: `13:05:59`."""
    return time.strftime("%H:%M:%S", time.localtime(t))


def _printable(value: Any) -> Any:
    if isinstance(value, str):
        return text.line(value)
    if isinstance(value, list | tuple):
        return [_printable(part) for part in value]
    if isinstance(value, dict):
        return {_printable(key): _printable(part) for key, part in value.items()}
    return value


def _escaped(document: bytes) -> str:
    """JSON in which what is not printable is escaped; that can only be within its texts."""

    def escape(found: re.Match[str]) -> str:
        if found[0].isprintable():
            return found[0]
        units = found[0].encode("utf-16-be").hex()
        return "".join(f"\\u{units[i : i + 4]}" for i in range(0, len(units), 4))

    return re.sub(r"[^\x20-\x7e\n]", escape, document.decode())


def criterion_words(quantities: Mapping[str, float], when: str) -> str:
    """Return the C that `swing --C auto` uses, from its quantities.

    when: such as "at the end"
    """
    lead = quantities.get("lead")
    ahead = f", of the speed that is predicted {lead:g} s ahead" if lead else ""
    turns = ", in turn with another one" if quantities.get("halfway") else ""
    return f"C = {quantities['criterion']:g} {when}{ahead}{turns}"
