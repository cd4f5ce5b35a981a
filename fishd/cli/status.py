"""`fishctl status`: the state of the fish and of its daemon, on one page."""

import datetime

import click

from fishd.cli.options import daemon_options
from fishd.cli.output import (
    echo_rows,
    format_controller,
    format_criterion,
    format_quantities,
    format_reason,
    make_printable,
    print_json,
    report_detour,
)
from fishd.client import Fish
from fishd.core.console import format_reading, format_thrust
from fishd.core.robots import find_kind
from fishd.core.schema import format_values
from fishd.core.signals import Percentiles, Status

_REMEDIES_PAGE = "docs/how-to/troubleshooting.md"
_ZERO_UNKNOWN_NOTE = "(its zero is not known: stop for 3 s, then swim on; or fishctl measure)"


@click.command()
@click.option("--timing", is_flag=True, help="Also show the timing of the loop.")
@daemon_options
def status(timing: bool, endpoint: str | None, as_json: bool) -> None:
    """Show what the fish and its daemon are doing."""
    with Fish(endpoint) as fish:
        fish_status = fish.status()
    report_detour(fish)
    address = f" --endpoint {fish_status.control}" if fish.detour and fish_status.control else ""
    if as_json:
        print_json(fish_status)
        return
    rows = _status_rows(fish_status := make_printable(fish_status), address)
    if timing:
        rows += _timing_rows(fish_status)
    echo_rows(rows)


def _status_rows(status: Status, address: str) -> list[tuple[str, str]]:
    """Return names and values: those of the fish first, those of the daemon last.

    address: options with which the next verb reaches this fishd
    """
    mode = [("mode", status.mode)]
    if reason := status.reason:
        remedy = f"{reason.remedy or 'mend the cause'} ({_REMEDIES_PAGE}, {reason.code})"
        mode = [
            ("mode", f"{status.mode} ({format_reason(reason)})"),
            ("to do", f"{remedy}; then: fishctl clear-fault{address}"),
        ]
    if holder := status.lease:
        mode.append(("held by", f"{holder}, for {holder.age:.0f} s"))
    if expired := status.lease_expiry:
        mode.append(("rests, as", f"{expired.message} ({_REMEDIES_PAGE}, {expired.code})"))
    uptime = datetime.timedelta(seconds=int(status.uptime))
    errors = {name: count for name, count in status.recovered_errors.items() if count}
    missed = f"slots missed: {status.missed_slots}, overruns: {status.overruns}; see --timing"
    return [
        ("fish", f"{status.name}, {status.robot}"),
        *mode,
        ("controller", format_controller(status.controller, status.parameters)),
        *([("", f"took over: {format_reason(status.fallback)}")] if status.fallback else []),
        ("angle", f"{_format_angle(status)}, {_format_range(status)}"),
        *_thrust_rows(status),
        *([("leak", f"{status.leak:.3g} s, estimated")] if status.leak is not None else []),
        *_reading_rows(status),
        *_criterion_rows(status),
        *([("shows", shown)] if (shown := _format_shown(status)) else []),
        *([("calibrating", "the servo, by a client")] if status.calibrating else []),
        *(("limitation", line) for line in status.limitations),
        *([("recovered", format_values(errors, {}))] if errors else []),
        *([("late", missed)] if status.missed_slots or status.overruns else []),
        ("daemon", f"fishd {status.version}, pid {status.pid}, up {uptime}"),
        ("control", status.control or "none: see limitation"),
        ("telemetry", status.telemetry),
    ]


def _criterion_rows(status: Status) -> list[tuple[str, str]]:
    """Return the C that `swing --C auto` has chosen, or tries."""
    quantities = status.quantities
    if status.parameters.get("C") != "auto" or "criterion" not in quantities:
        return []
    when = "on trial, or the best yet" if quantities.get("searching") else "chosen"
    return [("C auto", format_criterion(quantities, when))]


def _thrust_rows(status: Status) -> list[tuple[str, str]]:
    if status.speed is not None:
        return [("speed", f"{status.speed * 1e3:.1f} mm/s at {status.frequency:.2f} Hz")]
    rows = [("thrust", f"{format_thrust(status)} at {status.frequency:.2f} Hz")]
    if status.thrust_ci95 is None and not status.sensor_lost:
        rows.append(("", _ZERO_UNKNOWN_NOTE))
    return rows


def _reading_rows(status: Status) -> list[tuple[str, str]]:
    """Return a row for each sensor, with its readings, and their age if it is long."""
    rows: dict[str, list[str]] = {}
    for name, reading in status.readings.items():
        shown = "–" if reading.value is None else format_reading(reading)
        age = reading.age or 0.0
        shown += f" ({age:.0f} s old)" if age >= 2.0 else ""
        rows.setdefault(reading.sensor, []).append(f"{name} {shown}")
    return [(sensor, ", ".join(values)) for sensor, values in rows.items()]


def _timing_rows(status: Status) -> list[tuple[str, str]]:
    timing = status.timing
    scheduling = "real-time" if status.realtime else "normal"
    loop = ("loop", f"tick {status.seq} of {status.tick * 1e3:g} ms, {scheduling} scheduling")
    if not find_kind(status.robot).is_real_time:
        return [loop, ("", "in slow motion no tick is late")]
    return [
        loop,
        ("", f"slots missed: {status.missed_slots}, overruns: {status.overruns}"),
        ("lateness", _format_percentiles(timing.lateness)),
        ("duration", _format_percentiles(timing.duration)),
        *((f"  {phase}", _format_percentiles(times)) for phase, times in timing.phases.items()),
    ]


def _format_shown(status: Status) -> str:
    pairs = format_quantities(status.quantities, status.quantity_units)
    return ", ".join(f"{name} {value}" for name, value in pairs)


def _format_angle(status: Status) -> str:
    if not status.servo_on:
        return "no pulses"
    lost = "; the servo cannot be reached, may still have pulses" if status.servo_lost else ""
    return f"{status.phi_c:+.3f} rad{lost}"


def _format_range(status: Status) -> str:
    """Return the angles that the tail can be sent to."""
    limit = status.amplitude_limit
    if (status.lowest_angle, status.highest_angle) == (-limit, limit):
        return f"within ±{limit:g} rad"
    return (
        f"within {status.lowest_angle:+.4g} to {status.highest_angle:+.4g} rad, less than "
        f"±{limit:g} rad of amplitude_limit"
    )


def _format_percentiles(times: Percentiles) -> str:
    return (
        f"p50 {times.p50:.0f} µs, p99 {times.p99:.0f} µs, "
        f"max {times.max:.0f} µs in tick {times.max_seq}"
    )
