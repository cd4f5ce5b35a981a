"""Names of fields before version 2 of the protocol, for files that were written with them.

docs/reference/protocol.md lists the fields of messages; its table is generated from `OLD_NAMES`.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from fishd.core.decoding import decoder

OLD_NAMES: dict[str, dict[str, str]] = {
    "tick": {
        "thrust_error": "thrust_ci95",
        "thrust_factor_error": "thrust_factor_ci95",
        "missed": "missed_slots",
        "age_ms": "sample_age_ms",
        "busy_us": "busy_time_us",
    },
    "status": {
        "thrust_error": "thrust_ci95",
        "counters": "recovered_errors",
        "degraded": "limitations",
        "lowest": "lowest_angle",
        "highest": "highest_angle",
        "missed": "missed_slots",
        "boot": "boot_id",
        "lease_expired": "lease_expiry",
    },
    "timing": {"busy": "duration"},
    "distribution": {"worst": "max", "worst_seq": "max_seq"},
    "event overrun": {"missed": "missed_slots"},
    "calibration": {"load_error": "load_ci95", "tared": "tare_date"},
    "daemon": {"lowest": "lowest_angle", "highest": "highest_angle"},
    "frame": {"dropped": "dropped_frames"},
    "summary": {
        "thrust_error": "thrust_ci95",
        "lost": "lost_ticks",
        "missed": "missed_slots",
        "swimming": "swim_ticks",
        "frames_lost": "lost_frames",
    },
    "sweep": {
        "error": "thrust_ci95",
        "thrust_per_watt_error": "thrust_per_watt_ci95",
        "trouble": "failure",
        "settled": "settled_time",
    },
    "camera of a training": {"eye": "feature_extractor", "babble": "random_excitation"},
    "training": {
        "error": "thrust_ci95",
        "swam": "swim_time",
        "stalled": "is_stalled",
        "worst": "lowest_relative_thrust",
        "lost": "lost_ticks",
        "blind": "blind_ticks",
    },
    "estimate": {"low": "ci95_low", "high": "ci95_high"},
    "controller excitation": {"lowest": "lowest_frequency", "highest": "highest_frequency"},
    "optimise": {
        "error": "thrust_ci95",
        "power_error": "power_ci95",
        "swum": "swim_ticks",
        "passed": "tank_time",
    },
}
"""Present name of each old field, by kind of message, metadata or table."""


def rename_keys(kind: str, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields with their present names."""
    names = OLD_NAMES[kind]
    return {names.get(name, name): value for name, value in fields.items()}


def rename_parameters(controller: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the recorded parameters of a controller with their present names."""
    names = OLD_NAMES.get(f"controller {controller}", {})
    return {names.get(name, name): value for name, value in parameters.items()}


def rename_message(kind: str, payload: bytes) -> bytes:
    """Return a message in JSON with the present names; one that is not an object is not changed.

    kind: topic of the message, or `calibrations` for the attachment of a recording
    """
    try:
        message = _decode(payload)
    except msgspec.DecodeError:
        return payload
    if not isinstance(message, dict):
        return payload
    if kind == "calibrations":
        _rename_part(message, "force", "calibration")
    elif kind == "event":
        if message.get("kind") == "overrun":
            _rename_part(message, "data", "event overrun")
    else:
        message = rename_keys(kind, message)
    _rename_part(message, "timing", "timing")
    timing = message.get("timing")
    if isinstance(timing, dict):
        phases = timing.get("phases")
        for part in (phases if isinstance(phases, dict) else {}, timing):
            for name in part:
                _rename_part(part, name, "distribution")
    return msgspec.json.encode(message)


def _rename_part(message: dict[str, Any], name: str, kind: str) -> None:
    """Rename the fields of an object in a message, if it is there."""
    if isinstance(message.get(name), dict):
        message[name] = rename_keys(kind, message[name])


_decode = decoder(Any)


def rename_columns(kind: str, columns: Sequence[str]) -> list[str]:
    """Return the columns of a table of this kind of experiment with their present names."""
    names = OLD_NAMES.get(kind, {})
    if "speed" in columns:
        names = {**names, "error": "speed_ci95"}
    return [names.get(name, name) for name in columns]
