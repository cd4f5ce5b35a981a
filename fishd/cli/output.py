"""Printing of values: control characters of a daemon or a file never reach the terminal."""

import os
import re
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
import msgspec

from fishd.core import text
from fishd.core.console import describe_write_error, discard_output
from fishd.core.schema import format_values
from fishd.core.signals import Reason

if TYPE_CHECKING:
    from rich.table import Table

    from fishd.client import Fish
    from fishd.core.protocol import State

T = TypeVar("T")

PIPE_COLUMNS = 1000
"""Width of a table in a file or a pipe [columns]."""
_MAX_OUTPUT_CHARACTERS = 1_000_000
"""Largest output that is not cut, more than any verb prints [characters]."""


def echo(message: Any = "", *, err: bool = False, nl: bool = True) -> None:
    """Print lines, with control characters removed; err: on standard error."""
    click.echo(text.block(str(message), _MAX_OUTPUT_CHARACTERS), err=err, nl=nl)


@contextmanager
def output_may_fail(done: str) -> Iterator[None]:
    """Discard output that cannot be written, and report that with what was done.

    For verbs whose exit status is that of the servo. done: what was done, in words
    """
    try:
        yield
    except OSError as error:
        discard_output()
        with suppress(OSError):
            echo(f"fishctl: {done}; {describe_write_error(error)}", err=True)


def report_detour(fish: "Fish") -> None:
    """Print to standard error how a fishd was reached that is not where clients look for it."""
    if fish.detour:
        echo(f"fishctl: {fish.detour}", err=True)


def echo_rows(rows: Sequence[tuple[str, str]]) -> None:
    """Print names and values in two columns."""
    width = max(12, *(len(name) + 1 for name, _ in rows))
    echo("\n".join(f"{name:<{width}}{value}" for name, value in rows))


def echo_table(table: "Table") -> None:
    """Print a table; in a file or a pipe, its lines are not wrapped."""
    from rich.console import Console

    Console(width=None if sys.stdout.isatty() else PIPE_COLUMNS, markup=False).print(table)


def print_json(value: Any) -> None:
    """Print any struct, or list of them, as one indented JSON document; a path is a text there."""
    document = msgspec.json.encode(value, enc_hook=os.fspath)
    click.echo(_escape_unprintable(msgspec.json.format(document, indent=2)))


def print_paths(paths: Iterable[Path], as_json: bool) -> None:
    """Print the files that a verb has written, a line each or as a list."""
    if as_json:
        print_json([str(path) for path in paths])
    else:
        for path in paths:
            echo(path)


def print_json_line(value: Any, *, err: bool = False) -> None:
    """Print any struct as one line of JSON; err: on standard error."""
    click.echo(_escape_unprintable(msgspec.json.encode(value)), err=err)


def make_printable(value: T) -> T:
    """Return a struct, or a list of them, with each of its texts as one printable line."""
    return msgspec.convert(_make_printable(msgspec.to_builtins(value)), type(value))


def format_controller(controller: str, parameters: dict[str, Any]) -> str:
    """Return a controller with its parameters, as `square frequency=1.7 Hz amplitude=default`."""
    if not parameters:
        return text.line(controller)
    from fishd.controllers import registry  # its import is slow

    return text.line(f"{controller} {format_values(parameters, registry.units(controller))}")


def format_state(state: "State") -> str:
    """Return mode, reason and controller."""
    state = make_printable(state)
    reason = f" ({format_reason(state.reason)})" if state.reason else ""
    return f"{state.mode}{reason}: {format_controller(state.controller, state.parameters)}"


def format_reason(reason: Reason) -> str:
    """Return the message of the reason of a mode, after its code unless that is `estop`."""
    return reason.message if reason.code == "estop" else f"{reason.code}: {reason.message}"


def format_quantities(quantities: dict[str, float], units: dict[str, str]) -> list[tuple[str, str]]:
    """Return names of quantities, and their values with units: `("top_speed", "2.31")`."""
    rows = []
    for name, value in quantities.items():
        unit = text.quoted(units.get(name, "1"))
        rows.append((text.quoted(name), f"{value:.3g}" + (f" {unit}" if unit != "1" else "")))
    return rows


def format_count(number: int, noun: str) -> str:
    """Return a number with its noun: `1 warning`, `2 warnings`."""
    return f"{number} {noun}" + ("" if number == 1 else "s")


def warn_of_fin(amplitude: float, where: str = "") -> None:
    """Warn if a simulated fin swings further than its equations hold.

    amplitude: largest fin angle [rad]; where: place of that amplitude, in words
    """
    from fishd.virtual.plant.parameters import MAX_FIN_ANGLE_RAD

    if amplitude > MAX_FIN_ANGLE_RAD:
        echo(
            f"fishctl: the fin swings by ±{amplitude:.2f} rad{where}: beyond {MAX_FIN_ANGLE_RAD:g} "
            "rad the equations of the fish do not hold, nor does this thrust",
            err=True,
        )


def format_speed(speed: float, ci95: float | None, grid_error: float | None) -> str:
    """Return a speed with its errors by averaging and by the grid."""
    value = text.format_measured(speed, ci95, "m/s")
    if grid_error is None:
        return f"{value}, grid error not known (fishctl swimmer refine)"
    return f"{value}, {text.format_half_width(grid_error)} by the grid"


def format_ratio(ratio: float, grid_error: float) -> str:
    """Return a ratio of speeds with its error by the grid."""
    return f"{ratio:.3f} ± {grid_error:.3f} by the grid"


def format_time_of_day(t: float) -> str:
    """Return the local time of day of a unix time [s]: `13:05:59`."""
    return time.strftime("%H:%M:%S", time.localtime(t))


def _make_printable(value: Any) -> Any:
    if isinstance(value, str):
        return text.line(value)
    if isinstance(value, list | tuple):
        return [_make_printable(part) for part in value]
    if isinstance(value, dict):
        return {_make_printable(key): _make_printable(part) for key, part in value.items()}
    return value


def _escape_unprintable(document: bytes) -> str:
    """Return JSON with unprintable characters escaped; these can only be within its texts."""

    def escape(match: re.Match[str]) -> str:
        if match[0].isprintable():
            return match[0]
        units = match[0].encode("utf-16-be").hex()
        return "".join(f"\\u{units[i : i + 4]}" for i in range(0, len(units), 4))

    return re.sub(r"[^\x20-\x7e\n]", escape, document.decode())


def format_criterion(quantities: Mapping[str, float], when: str) -> str:
    """Return the C that `swing --C auto` uses, from its quantities.

    when: time of the quantities, such as "at the end"
    """
    lead = quantities.get("lead")
    ahead = f", of the speed that is predicted {lead:g} s ahead" if lead else ""
    turns = ", in turn with another one" if quantities.get("halfway") else ""
    hidden = "; the ripple of F_x does not rise above the noise"
    reason = "" if quantities.get("clear", 1.0) else hidden
    return f"C = {quantities['criterion']:g} {when}{ahead}{turns}{reason}"
