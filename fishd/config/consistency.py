"""Checks of keys against each other, and of values beyond simple bounds.

Each check raises `Problem` with the wrong key and what would be right.
"""

import math
import os
from collections.abc import Iterable, Mapping
from typing import Any

from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.core import files, robots
from fishd.core.addresses import ADDRESS_FORM, Ipc, find_listen_problem, is_local, parse
from fishd.core.errors import ParameterError, UnknownController, UnknownRobot
from fishd.core.process.unix_sockets import check_length
from fishd.core.robots import find_kind
from fishd.core.schema import Problem, convert
from fishd.hardware.driver import Claim
from fishd.hardware.servo import pulses
from fishd.hardware.settings import PanelSettings, ServoSettings
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.plant.parameters import PlantParameters


def check_robot(name: str, settings: Mapping[str, Any]) -> None:
    """Check that the robot is installed and accepts its settings."""
    try:
        kind = robots.registry().find(name)
    except UnknownRobot as error:
        raise Problem(
            ("robot",), f"{error}; installed: {', '.join(robots.registry().names())}"
        ) from None
    convert(settings, kind.Settings, prefix=("robot_settings",))


def check_start(controller: str | None, parameters: Mapping[str, Any], limits: Limits) -> None:
    """Check that the start controller is installed and accepts its parameters."""
    if controller is None:
        if parameters:
            raise Problem(
                ("start", "parameters"),
                "start.controller is not set; set it, or remove the parameters",
            )
        return
    try:
        registry.check(controller, parameters, limits)
    except UnknownController as error:
        raise Problem(("start", "controller"), str(error)) from None
    except ParameterError as error:
        raise Problem(("start", "parameters", *error.path), str(error)) from None


def check_addresses(telemetry: str, control: str | None) -> None:
    """Check that both addresses are valid and differ, and that `control` is of this machine."""
    if complaint := find_listen_problem(telemetry):
        raise Problem(("telemetry", "address"), f"'{telemetry}' is not valid: {complaint}")
    if control is None:
        return
    complaint = find_listen_problem(control)
    is_unbound = complaint is not None and complaint.startswith(ADDRESS_FORM)
    if is_unbound or not (complaint or is_local(control)):
        complaint = (
            "ipc://PATH or tcp://127.0.0.1:PORT is needed; requests can move the fish, so they are "
            "accepted only from this machine"
        )
    if complaint:
        raise Problem(("control", "address"), f"'{control}' is not valid: {complaint}")
    if control == telemetry:
        raise Problem(("control", "address"), f"'{control}' is already the address of telemetry")


def check_network(telemetry: str, keyed_control: str, keyed_telemetry: str) -> None:
    """Check the addresses for clients with a key, and that no other is open to the network."""
    for key, address in (("control", keyed_control), ("telemetry", keyed_telemetry)):
        complaint = find_listen_problem(address)
        if not complaint and isinstance(parse(address), Ipc):
            complaint = "tcp://HOST:PORT is needed"
        if complaint:
            raise Problem(("network", key), f"'{address}' is not valid: {complaint}")
    if not is_local(telemetry):
        raise Problem(
            ("telemetry", "address"),
            f"'{telemetry}' could be read without a key, but network.keys is set; write an address "
            "of this machine, such as tcp://127.0.0.1:9872",
        )


def check_state_folder(folder: str | None) -> None:
    """Check that the folder is a valid path, not in the home of an unknown user."""
    if folder is None:
        return
    try:
        is_valid = b"\0" not in os.fsencode(folder)
    except UnicodeEncodeError:
        is_valid = False
    if not is_valid:
        raise Problem(
            ("state_folder",),
            f"'{folder}' is not valid: a path has no zero byte and no lone surrogate",
        )
    if str(files.expand_user(folder)).startswith("~"):
        user = folder.partition("/")[0].removeprefix("~")
        why = f"this machine has no user '{user}'" if user else "this user has no home"
        raise Problem(
            ("state_folder",),
            f"'{folder}' is not valid: {why}; write the full path, such as /var/lib/fishd",
        )


def check_neutral(servo: ServoSettings) -> None:
    """Check that neutral has a valid pulse."""
    low, high = pulses.reach(servo)
    if not low <= 0.0 <= high:
        raise Problem(
            ("servo", "trim"),
            f"neutral would be a pulse of {servo.centre + servo.trim:g} µs, beyond 500 to 2500 µs",
        )


def check_pulses(servo: ServoSettings, amplitude: float) -> None:
    """Check that pulse widths permit all angles that Φ [rad] and the soft limits permit."""
    wanted = max(servo.lowest, -amplitude), min(servo.highest, amplitude)
    possible = pulses.pulse_reach(servo)
    if (
        possible[0] <= wanted[0] + pulses.ANGLE_TOLERANCE_RAD
        and wanted[1] - pulses.ANGLE_TOLERANCE_RAD <= possible[1]
    ):
        return
    neutral = servo.centre + servo.trim
    below, above = sorted(servo.direction * servo.scale * angle for angle in wanted)
    lowest, highest = pulses.MIN_PULSE_US - below, pulses.MAX_PULSE_US - above
    if lowest > highest:
        key = "scale"
        largest = (pulses.MAX_PULSE_US - pulses.MIN_PULSE_US) / (wanted[1] - wanted[0])
        remedy = f"at most {math.floor(largest)} µs/rad"
    else:
        key = "trim" if servo.trim else "centre"
        remedy = f"centre + trim from {math.ceil(lowest)} to {math.floor(highest)} µs"
    amplitude_reach = min(
        end for end, angle in zip(map(abs, possible), map(abs, wanted), strict=True) if end < angle
    )
    smaller = f", or an amplitude_limit of at most {math.floor(amplitude_reach * 1e3) / 1e3:g} rad"
    raise Problem(
        ("servo", key),
        f"{getattr(servo, key):g} is not valid: angles from {wanted[0]:+.4g} to {wanted[1]:+.4g} "
        f"rad would need pulses of {neutral + below:.0f} to {neutral + above:.0f} µs, beyond 500 "
        f"to 2500 µs; {remedy} is needed" + (smaller if amplitude_reach >= 1e-3 else ""),
    )


def check_pins(claims: Mapping[str, Iterable[Claim]], panel: PanelSettings) -> None:
    """Check that no pin is used twice. claims: claims of the drivers, by section"""
    uses = [
        (section, claim.key, pin, claim.what, f"{section}.{claim.key}")
        for section, section_claims in claims.items()
        for claim in section_claims
        for pin in claim.pins
    ]
    for key, pin in (("estop_gpio", panel.estop_gpio), ("led_gpio", panel.led_gpio)):
        if pin is not None:
            uses.append(("panel", key, pin, key, f"panel.{key}"))
    users: dict[int, tuple[str, str]] = {}
    for section, key, pin, what, user in uses:
        first_what, first_user = users.setdefault(pin, (what, user))
        if first_what != what:  # otherwise two drivers share a bus
            raise Problem((*section.split("."), key), f"GPIO {pin} is already used by {first_user}")


def check_i2c_addresses(settings: Mapping[str, Any]) -> None:
    """Check that no two chips have the same address. settings: those of the drivers, by section"""
    sections: dict[tuple[int, int], str] = {}
    for section, driver_settings in settings.items():
        bus, address = (getattr(driver_settings, key, None) for key in ("bus", "address"))
        if isinstance(bus, int) and isinstance(address, int):
            first_section = sections.setdefault((bus, address), section)
            if first_section != section:
                raise Problem(
                    (*section.split("."), "address"),
                    f"{address:#04x} on /dev/i2c-{bus} is already the address of {first_section}: "
                    "each chip needs a different address",
                )


def check_lockstep(robot: str, lockstep: bool) -> None:
    """Check that lockstep is used only with a simulated fish, whose time can stand still."""
    if lockstep and not find_kind(robot).is_real_time:
        raise Problem(
            ("lockstep",),
            f"true is not valid with robot: {robot}, whose time is always virtual and whose ticks "
            "wait for the agent of remote; false is needed",
        )
    if lockstep and robot != "simulated":
        raise Problem(
            ("lockstep",),
            f"true is not valid with robot: {robot}, whose time cannot stand still; "
            "robot: simulated is needed",
        )


def check_estimator(robot: str, kind: str, plant: PlantParameters) -> None:
    """Check that an observer has a model of the fish, and that a fin sensor exists."""
    if kind == "observer" and not find_kind(robot).is_tethered:
        raise Problem(
            ("estimator", "kind"),
            f"observer is not valid with robot: {robot}, since its model is of a tethered fish; "
            "tail, sensor or lateral_force is needed",
        )
    if kind in ("sensor", "tail") and find_kind(robot).is_tethered:
        raise Problem(
            ("estimator", "kind"),
            f"{kind} is not valid with robot: {robot}, which has no fin sensor; "
            "lateral_force or observer is needed",
        )
    if kind == "observer" and robot == "pi" and plant == PlantParameters():
        raise Problem(
            ("estimator", "kind"),
            "observer needs a model of this fish, but section plant is not set; run 'fishctl "
            "identify' to write it",
        )


def check_virtual_pi(pi: VirtualPiSettings) -> None:
    """Check that the virtual Pi can be built."""
    if pi.socket is not None:
        if not pi.socket:
            raise Problem(("virtual_pi", "socket"), "'' is not valid: a path or null is needed")
        try:
            check_length(pi.socket)
        except ValueError as error:
            raise Problem(
                ("virtual_pi", "socket"), f"'{pi.socket}' is not valid: {error}"
            ) from None
    if pi.servo_scale == 0.0:
        raise Problem(("virtual_pi", "servo_scale"), "0 is not valid: the servo would not turn")
    if pi.channel_x == pi.channel_y:
        raise Problem(("virtual_pi", "channel_y"), f"'{pi.channel_y}' is already channel_x")
