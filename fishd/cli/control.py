"""Verbs that talk to a running daemon: status, controllers, set-controller and so on."""

import datetime
import os
from typing import Any

import click

from fishd.addresses import ENDPOINT_VARIABLE
from fishd.cli.options import (
    ControllerGroup,
    ParameterType,
    describe,
    endpoint_option,
    json_option,
)
from fishd.cli.output import echo, made_printable, print_json, spelled
from fishd.client import Fish
from fishd.controllers import registry
from fishd.errors import NoDaemon
from fishd.protocol import State
from fishd.signals import Percentiles, Reason, Status


def daemon_options(function: Any) -> Any:
    """`--endpoint` and `--json`."""
    return endpoint_option(json_option(function))


@click.command()
@daemon_options
def status(endpoint: str | None, as_json: bool) -> None:
    """Show what the daemon is doing, and how well."""
    with Fish(endpoint) as fish:
        found = fish.status()
    if as_json:
        print_json(found)
    else:
        echo(_status_text(made_printable(found)))


@click.command()
@daemon_options
def controllers(endpoint: str | None, as_json: bool) -> None:
    """List the controllers that the daemon knows, and their parameters."""
    try:
        with Fish(endpoint) as fish:
            known = fish.controllers()
    except NoDaemon:
        if endpoint or os.environ.get(ENDPOINT_VARIABLE):
            raise
        echo("fishctl: no fishd is running; these controllers are installed here", err=True)
        known = registry.describe_all()
    if as_json:
        print_json(known)
        return
    for info in map(made_printable, known):
        click.echo(f"{click.style(info.name, bold=True)}  {info.summary}")
        for field in info.parameters:
            echo(f"    --{field.name.replace('_', '-'):<22} {describe(field)}")


@click.group(cls=ControllerGroup, options=daemon_options, remote=True)
def set_controller() -> None:
    """Put another controller in command; parameters left out take their defaults."""


@set_controller.action
def _set_controller(
    name: str, parameters: dict[str, Any], endpoint: str | None, as_json: bool
) -> None:
    with Fish(endpoint) as fish:
        _print_state(fish.set_controller(name, **parameters), as_json)


@click.command(context_settings={"ignore_unknown_options": True})  # -1 is a value
@click.argument("pairs", nargs=-1, required=True, metavar="NAME VALUE [NAME VALUE]...")
@daemon_options
def set_parameter(pairs: tuple[str, ...], endpoint: str | None, as_json: bool) -> None:
    """Change parameters of the running controller while the fish swims, all or none of them."""
    if len(pairs) % 2:
        raise click.UsageError("every NAME needs a VALUE, such as: C 0.7")
    with Fish(endpoint) as fish:
        running = fish.status().controller
        known = {
            field.name: field
            for i in fish.controllers()
            if i.name == running
            for field in i.parameters
        }
        values: dict[str, Any] = {}
        for given, text in zip(pairs[::2], pairs[1::2], strict=True):
            name = given.lstrip("-").replace("-", "_")
            field = known.get(name)
            # The daemon refuses a name that the controller does not have, and says which it has.
            values[name] = ParameterType(field).convert(text, None, None) if field else text
        _print_state(fish.set_parameters(**values), as_json)


@click.command()
@daemon_options
def stop(endpoint: str | None, as_json: bool) -> None:
    """Fade to neutral and stay there."""
    with Fish(endpoint) as fish:
        _print_state(fish.stop(), as_json)


@click.command()
@click.argument("message", default="requested with fishctl")
@daemon_options
def estop(message: str, endpoint: str | None, as_json: bool) -> None:
    """Emergency stop: no more pulses, at once, until 'fishctl clear-fault'."""
    with Fish(endpoint) as fish:
        _print_state(fish.estop(message), as_json)


@click.command()
@daemon_options
def clear_fault(endpoint: str | None, as_json: bool) -> None:
    """Leave mode fault or estop; the servo gets pulses again and goes to neutral."""
    with Fish(endpoint) as fish:
        _print_state(fish.clear_fault(), as_json)


@click.command()
@click.argument("words", metavar="TEXT")
@daemon_options
def mark(words: str, endpoint: str | None, as_json: bool) -> None:
    """Put a mark in the event stream, such as what you just changed on the rig."""
    with Fish(endpoint) as fish:
        state = fish.mark(words)
    if as_json:
        print_json(state)
    else:
        echo(f"marked before tick {state.seq}: {words}")


def _print_state(state: State, as_json: bool) -> None:
    if as_json:
        print_json(state)
        return
    state = made_printable(state)
    why = f" ({_why(state.reason)})" if state.reason else ""
    echo(f"{state.mode}{why}: {state.controller} {spelled(state.parameters)}".rstrip())


def _status_text(status: Status) -> str:
    reason = f" ({_why(status.reason)})" if status.reason else ""
    timing = status.timing
    thrust = "–" if status.sensor_lost else f"{status.thrust * 1e3:.2f}"
    scheduling = "real-time" if status.realtime else "normal"
    uptime = datetime.timedelta(seconds=int(status.uptime))
    survived = {name: count for name, count in status.counters.items() if count}
    rows = [
        ("mode", status.mode + reason),
        ("controller", f"{status.controller} {spelled(status.parameters)}"),
        *([("", f"took over: {_why(status.fallback)}")] if status.fallback else []),
        ("thrust", f"{thrust} mN at {status.frequency:.2f} Hz"),
        ("servo", f"{_servo(status)}, {_range(status)}"),
        ("loop", f"tick {status.seq} of {status.tick * 1e3:g} ms, {scheduling} scheduling"),
        ("", f"slots missed: {status.missed}, overruns: {status.overruns}"),
        ("late", _percentiles(timing.lateness)),
        ("busy", _percentiles(timing.busy)),
        *((f"  {phase}", _percentiles(times)) for phase, times in timing.phases.items()),
        *([("calibrating", "the servo, by a client")] if status.calibrating else []),
        ("robot", status.robot),
        *(("degraded", line) for line in status.degraded),
        *([("survived", spelled(survived))] if survived else []),
        ("daemon", f"fishd {status.version}, pid {status.pid}, up {uptime}"),
        ("telemetry", status.telemetry),
    ]
    return "\n".join(f"{name:<12}{value}" for name, value in rows)


def _servo(status: Status) -> str:
    if not status.servo_on:
        return "no pulses"
    return "cannot be reached, may still have pulses" if status.servo_lost else "on"


def _range(status: Status) -> str:
    """The angles that the tail can be sent to."""
    limit = status.amplitude_limit
    if (status.lowest, status.highest) == (-limit, limit):
        return f"within ±{limit:g} rad"
    return (
        f"within {status.lowest:+.4g} to {status.highest:+.4g} rad, less than ±{limit:g} rad of "
        "amplitude_limit"
    )


def _why(reason: Reason) -> str:
    return reason.message if reason.code == "estop" else f"{reason.code}: {reason.message}"


def _percentiles(times: Percentiles) -> str:
    return (
        f"p50 {times.p50:.0f} µs, p99 {times.p99:.0f} µs, "
        f"worst {times.worst:.0f} µs in tick {times.worst_seq}"
    )
