"""Verbs that talk to a running daemon: status, controllers, set-controller and so on."""

import datetime
import os
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any, TypeVar

import click

from fishd.cli.completion import active_parameters, complete_pair
from fishd.cli.options import ControllerGroup, ParameterType, Words, daemon_options, describe
from fishd.cli.output import (
    criterion_words,
    echo,
    echo_rows,
    format_reason,
    made_printable,
    measured,
    print_json,
    spelled,
    state_line,
)
from fishd.cli.plausibility import running_config, warn_of_values
from fishd.client import Fish
from fishd.controllers import registry
from fishd.core.addresses import ENDPOINT_VARIABLE
from fishd.core.console import power_words, thrust_words
from fishd.core.errors import NoDaemon, UnknownController
from fishd.core.protocol import State
from fishd.core.schema import Field, format_values, nearest
from fishd.core.signals import Percentiles, Status

T = TypeVar("T")
_HELP = "docs/how-to/troubleshooting.md"
_ZERO = "(its zero is not known: stop for 3 s, then swim on; or fishctl measure)"


@click.command()
@click.option("--timing", is_flag=True, help="Show how well the loop keeps its time, too.")
@daemon_options
def status(timing: bool, endpoint: str | None, as_json: bool) -> None:
    """Show what the fish and its daemon are doing."""
    with Fish(endpoint) as fish:
        found = fish.status()
    if as_json:
        print_json(found)
        return
    rows = _status_rows(found := made_printable(found))
    if timing:
        rows += _timing_rows(found)
    echo_rows(rows)


def asked(
    endpoint: str | None, ask: Callable[[Fish], list[T]], look: Callable[[], list[T]], what: str
) -> list[T]:
    """What the daemon knows; where none runs and none was named, what is found without it."""
    try:
        with Fish(endpoint) as fish:
            return ask(fish)
    except NoDaemon:
        if endpoint or os.environ.get(ENDPOINT_VARIABLE):
            raise
        echo(f"fishctl: no fishd is running; these {what} are found from here", err=True)
        return look()


@click.command()
@click.argument("name", required=False, metavar="[NAME]")
@daemon_options
def controllers(name: str | None, endpoint: str | None, as_json: bool) -> None:
    """List the controllers that the daemon knows, or show the one of that NAME.

    Each with its parameters, as options, and the quantities of its own that telemetry shows.
    """
    known = asked(endpoint, Fish.controllers, registry.describe_all, "controllers")
    if name is not None:
        names = [info.name for info in known]
        if name not in names:
            hint = nearest(name, names)
            raise UnknownController(f"no controller is named '{name}'; {hint}")
        known = [info for info in known if info.name == name]
    if as_json:
        print_json(known)
        return
    for info in map(made_printable, known):
        click.echo(f"{click.style(info.name, bold=True)}  {info.summary}")
        for field in info.parameters:
            echo(f"    --{field.name.replace('_', '-'):<22} {describe(field)}")
        for quantity in info.quantities:
            unit = "" if quantity.unit == "1" else f" [{quantity.unit}]"
            echo(f"    shows {quantity.name:<18} {quantity.description.rstrip('.')}{unit}")


@click.group(cls=ControllerGroup, options=daemon_options, remote=True)
def set_controller() -> None:
    """Let another controller swim; parameters left out take their defaults."""


@set_controller.action
def _set_controller(
    name: str, parameters: dict[str, Any], endpoint: str | None, as_json: bool
) -> None:
    _change(endpoint, as_json, lambda fish: fish.set_controller(name, **parameters))


@click.command(context_settings={"ignore_unknown_options": True})  # -1 is a value
@click.argument(
    "words",
    nargs=-1,
    required=True,
    metavar="NAME VALUE|NAME=VALUE...",
    shell_complete=complete_pair,
)
@daemon_options
def set_parameter(words: tuple[str, ...], endpoint: str | None, as_json: bool) -> None:
    """Change parameters of the running controller while the fish swims, all or none of them."""
    pairs = list(_pairs(words))

    def change(fish: Fish) -> State:
        known = active_parameters(fish)
        # The daemon refuses a name that the controller does not have, and says which it has.
        values = {
            name: _converted(known[name], text) if name in known else text for name, text in pairs
        }
        state = fish.set_parameters(**values)
        warn_of_values(known.values(), values, partial(running_config, fish))
        return state

    _change(endpoint, as_json, change)


def _converted(field: Field, text: str) -> Any:
    try:
        return ParameterType(field).convert(text, None, None)
    except click.BadParameter as error:
        error.param_hint = f"'{field.name}'"
        raise


def _pairs(words: Iterable[str]) -> Iterator[tuple[str, str]]:
    """Names and values of `NAME VALUE`, `NAME=VALUE` and `--NAME VALUE`, in any mixture."""
    rest, given = iter(words), set[str]()
    for word in rest:
        name, equals, text = word.partition("=")
        value = text if equals else next(rest, None)
        if value is None:
            raise click.UsageError(f"every NAME needs a VALUE, such as: {name} 0.7, or {name}=0.7")
        name = name.lstrip("-").replace("-", "_")
        if name in given:
            raise click.UsageError(f"{name} is given twice")
        given.add(name)
        yield name, value


@click.command()
@daemon_options
def stop(endpoint: str | None, as_json: bool) -> None:
    """Fade to neutral and stay there."""
    _change(endpoint, as_json, Fish.stop)


@click.command()
@daemon_options
def clear_fault(endpoint: str | None, as_json: bool) -> None:
    """Leave mode fault or estop; the servo gets pulses again and goes to neutral."""
    _change(endpoint, as_json, Fish.clear_fault)


@click.command()
@click.argument("words", metavar="TEXT", type=Words())
@daemon_options
def mark(words: str, endpoint: str | None, as_json: bool) -> None:
    """Put a mark in the event stream, such as what you just changed on the rig."""
    with Fish(endpoint) as fish:
        state = fish.mark(words)
    if as_json:
        print_json(state)
    else:
        echo(f"marked before tick {state.seq}: {words}")


def _change(endpoint: str | None, as_json: bool, change: Callable[[Fish], State]) -> None:
    """Ask for a change, and print the state afterwards."""
    with Fish(endpoint) as fish:
        state = change(fish)
    if as_json:
        print_json(state)
        return
    echo(state_line(state))
    if holder := state.took_from:
        taken = made_printable(holder)
        echo(f"fishctl: took the fish from {taken}, which had it for {holder.age:.0f} s", err=True)


def _status_rows(status: Status) -> list[tuple[str, str]]:
    """The fish first, the daemon last."""
    mode = [("mode", status.mode)]
    if reason := status.reason:
        remedy = f"{reason.remedy or 'mend the cause'} ({_HELP}, {reason.code})"
        mode = [
            ("mode", f"{status.mode} ({format_reason(reason)})"),
            ("to do", f"{remedy}; then: fishctl clear-fault"),
        ]
    if holder := status.lease:
        mode.append(("held by", f"{holder}, for {holder.age:.0f} s"))
    if expired := status.lease_expired:
        mode.append(("rests, as", f"{expired.message} ({_HELP}, {expired.code})"))
    uptime = datetime.timedelta(seconds=int(status.uptime))
    survived = {name: count for name, count in status.counters.items() if count}
    missed = f"slots missed: {status.missed}, overruns: {status.overruns}; see --timing"
    return [
        ("fish", f"{status.name}, {status.robot}"),
        *mode,
        ("controller", spelled(status.controller, status.parameters)),
        *([("", f"took over: {format_reason(status.fallback)}")] if status.fallback else []),
        ("angle", f"{_angle(status)}, {_range(status)}"),
        *_swum(status),
        *([("leak", f"{status.leak:.3g} s, found")] if status.leak is not None else []),
        *_criterion(status),
        *([("shows", shown)] if (shown := _quantities(status)) else []),
        *([("calibrating", "the servo, by a client")] if status.calibrating else []),
        *(("degraded", line) for line in status.degraded),
        *([("survived", format_values(survived, {}))] if survived else []),
        *([("late", missed)] if status.missed or status.overruns else []),
        ("daemon", f"fishd {status.version}, pid {status.pid}, up {uptime}"),
        ("telemetry", status.telemetry),
    ]


def _criterion(status: Status) -> list[tuple[str, str]]:
    """Return what `swing --C auto` has found, or tries."""
    quantities = status.quantities
    if status.parameters.get("C") != "auto" or "criterion" not in quantities:
        return []
    when = "on trial, or the best so far" if quantities.get("searching") else "found"
    return [("C auto", criterion_words(quantities, when))]


def _swum(status: Status) -> list[tuple[str, str]]:
    if status.speed is not None:
        return [("speed", f"{status.speed * 1e3:.1f} mm/s at {status.frequency:.2f} Hz")]
    rows = [("thrust", f"{thrust_words(status)} at {status.frequency:.2f} Hz")]
    if status.thrust_error is None and not status.sensor_lost:
        rows.append(("", _ZERO))
    if status.power is not None:
        rows.append(("power", f"{power_words(status.power)} into the servo, mean of 2 s"))
    return rows


def _timing_rows(status: Status) -> list[tuple[str, str]]:
    timing = status.timing
    scheduling = "real-time" if status.realtime else "normal"
    loop = ("loop", f"tick {status.seq} of {status.tick * 1e3:g} ms, {scheduling} scheduling")
    if status.robot == "swimmer":
        return [loop, ("", "in slow motion no tick is late")]
    return [
        loop,
        ("", f"slots missed: {status.missed}, overruns: {status.overruns}"),
        ("late", _percentiles(timing.lateness)),
        ("busy", _percentiles(timing.busy)),
        *((f"  {phase}", _percentiles(times)) for phase, times in timing.phases.items()),
    ]


def _quantities(status: Status) -> str:
    each = measured(status.quantities, status.quantity_units)
    return ", ".join(f"{name} {value}" for name, value in each)


def _angle(status: Status) -> str:
    if not status.servo_on:
        return "no pulses"
    lost = "; the servo cannot be reached, may still have pulses" if status.servo_lost else ""
    return f"{status.phi_c:+.3f} rad{lost}"


def _range(status: Status) -> str:
    """The angles that the tail can be sent to."""
    limit = status.amplitude_limit
    if (status.lowest, status.highest) == (-limit, limit):
        return f"within ±{limit:g} rad"
    return (
        f"within {status.lowest:+.4g} to {status.highest:+.4g} rad, less than ±{limit:g} rad of "
        "amplitude_limit"
    )


def _percentiles(times: Percentiles) -> str:
    return (
        f"p50 {times.p50:.0f} µs, p99 {times.p99:.0f} µs, "
        f"worst {times.worst:.0f} µs in tick {times.worst_seq}"
    )
