"""Cross-field validation of the configuration, and of what no bound can express.

Each check raises `Problem` with the key at fault and what would be right.
"""

import math
import os
from collections.abc import Iterable, Mapping
from typing import Any

from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.core import files
from fishd.core.addresses import FORM, is_local, why_not_served
from fishd.core.errors import ParameterError, UnknownController
from fishd.core.process.unix_sockets import check_length
from fishd.core.schema import Problem
from fishd.hardware.driver import Claim
from fishd.hardware.servo import pulses
from fishd.hardware.settings import PanelSettings, ServoSettings
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.swimmer.settings import SwimmerSettings

MOST_STEPS = 200
"""Of a swimmer in a tick: between two ticks fishd answers nobody."""


def check_start(controller: str | None, parameters: Mapping[str, Any], limits: Limits) -> None:
    """The controller to start with is installed and accepts its parameters."""
    if controller is None:
        if parameters:
            raise Problem(
                ("start", "parameters"),
                "there is no start.controller to take these; name one, or remove them",
            )
        return
    try:
        registry.check(controller, parameters, limits)
    except UnknownController as error:
        raise Problem(("start", "controller"), str(error)) from None
    except ParameterError as error:
        raise Problem(("start", "parameters", *error.path), str(error)) from None


def check_addresses(telemetry: str, control: str | None) -> None:
    """Both are valid and differ, and only this machine can reach `control`."""
    if complaint := why_not_served(telemetry):
        raise Problem(("telemetry", "address"), f"'{telemetry}' is not valid: {complaint}")
    if control is None:
        return
    complaint = why_not_served(control)
    if complaint.startswith(FORM) or not (complaint or is_local(control)):
        complaint = (
            "ipc://PATH or tcp://127.0.0.1:PORT is needed; who can send requests can move the "
            "fish, so they are taken from this machine only"
        )
    if complaint:
        raise Problem(("control", "address"), f"'{control}' is not valid: {complaint}")
    if control == telemetry:
        raise Problem(("control", "address"), f"'{control}' is the address of telemetry already")


def check_state_folder(folder: str | None) -> None:
    """It is a path, in no home that this machine does not have."""
    if folder is None:
        return
    try:
        good = b"\0" not in os.fsencode(folder)
    except UnicodeEncodeError:
        good = False
    if not good:
        raise Problem(
            ("state_folder",),
            f"'{folder}' is not valid: a path has no zero byte and no half of a character",
        )
    if str(files.expanded(folder)).startswith("~"):
        user = folder.partition("/")[0].removeprefix("~")
        why = f"no user here is '{user}'" if user else "this user has no home"
        raise Problem(
            ("state_folder",),
            f"'{folder}' is not valid: {why}; write it out, such as /var/lib/fishd",
        )


def check_neutral(servo: ServoSettings) -> None:
    """Neutral has a pulse."""
    low, high = pulses.reach(servo)
    if not low <= 0.0 <= high:
        raise Problem(
            ("servo", "trim"),
            f"neutral would be a pulse of {servo.centre + servo.trim:g} µs, beyond 500 to 2500 µs",
        )


def check_pulses(servo: ServoSettings, amplitude: float) -> None:
    """Pulse widths permit what Φ [rad] and the soft limits do; who wants less says so by those."""
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
        most = (pulses.MAX_PULSE_US - pulses.MIN_PULSE_US) / (wanted[1] - wanted[0])
        right = f"at most {math.floor(most)} µs/rad"
    else:
        key = "trim" if servo.trim else "centre"
        right = f"centre + trim from {math.ceil(lowest)} to {math.floor(highest)} µs"
    less = min(
        end for end, angle in zip(map(abs, possible), map(abs, wanted), strict=True) if end < angle
    )
    smaller = f", or an amplitude_limit of at most {math.floor(less * 1e3) / 1e3:g} rad"
    raise Problem(
        ("servo", key),
        f"{getattr(servo, key):g} is not valid: angles from {wanted[0]:+.4g} to {wanted[1]:+.4g} "
        f"rad would need pulses of {neutral + below:.0f} to {neutral + above:.0f} µs, beyond 500 "
        f"to 2500 µs; {right} is needed" + (smaller if less >= 1e-3 else ""),
    )


def check_pins(claims: Mapping[str, Iterable[Claim]], panel: PanelSettings) -> None:
    """No pin has two jobs. claims: those of the drivers, by their sections"""
    wanted = [
        (section, claim.key, pin, claim.what, f"{section}.{claim.key}")
        for section, found in claims.items()
        for claim in found
        for pin in claim.pins
    ]
    for key, pin in (("estop_gpio", panel.estop_gpio), ("led_gpio", panel.led_gpio)):
        if pin is not None:
            wanted.append(("panel", key, pin, key, f"panel.{key}"))
    jobs: dict[int, tuple[str, str]] = {}
    for section, key, pin, what, job in wanted:
        taken, by = jobs.setdefault(pin, (what, job))
        if taken != what:  # else two drivers are on one bus
            raise Problem((section, key), f"GPIO {pin} is taken by {by} already")


def check_i2c_addresses(settings: Mapping[str, Any]) -> None:
    """No two chips have the same address. settings: of the drivers, by their sections"""
    taken: dict[tuple[int, int], str] = {}
    for section, each in settings.items():
        bus, address = (getattr(each, key, None) for key in ("bus", "address"))
        if isinstance(bus, int) and isinstance(address, int):
            by = taken.setdefault((bus, address), section)
            if by != section:
                raise Problem(
                    (section, "address"),
                    f"{address:#04x} on /dev/i2c-{bus} is that of {by} already: each chip needs "
                    "an address of its own",
                )


def check_lockstep(robot: str, lockstep: bool) -> None:
    """Lockstep needs a simulated fish: only its time can stand still."""
    if lockstep and robot == "swimmer":
        raise Problem(
            ("lockstep",),
            "true is not valid with robot: swimmer, whose time is virtual anyway: its ticks wait "
            "for an agent of remote; false is needed",
        )
    if lockstep and robot != "simulated":
        raise Problem(
            ("lockstep",),
            f"true is not valid with robot: {robot}, whose time cannot stand still; "
            "robot: simulated is needed",
        )


def check_estimator(robot: str, kind: str, plant: PlantParameters) -> None:
    """An observer needs a model of the fish that swims, and a sensor has to be there."""
    if (robot, kind) == ("swimmer", "observer"):
        raise Problem(
            ("estimator", "kind"),
            "observer is not valid with robot: swimmer, since it believes in a tethered fish; "
            "sensor or lateral_force is needed",
        )
    if kind == "sensor" and robot != "swimmer":
        raise Problem(
            ("estimator", "kind"),
            f"sensor is not valid with robot: {robot}, which has no sensor of its fin; "
            "lateral_force or observer is needed",
        )
    if kind == "observer" and robot == "pi" and plant == PlantParameters():
        raise Problem(
            ("estimator", "kind"),
            "observer needs a model of this fish, and section plant is not given; 'fishctl "
            "identify' writes it",
        )


def check_swimmer(swimmer: SwimmerSettings, tick: float) -> None:
    """It can be computed; tick: period of the loop [s]."""
    from fishd.virtual.swimmer import feasibility  # of which no other robot has any need

    feasibility.check(swimmer)
    step = swimmer.numerics.step
    steps = max(1, round(tick / step))
    if abs(tick / step - steps) > 1e-6:
        raise Problem(
            ("tick",),
            f"{tick:g} s is no whole number of steps of swimmer.numerics.step, {step:g} s; "
            f"{steps * step:g} s would be",
        )
    if steps > MOST_STEPS:
        raise Problem(
            ("swimmer", "numerics", "step"),
            f"{step:g} s makes {steps} steps of a tick, and nothing answers meanwhile: at most "
            f"{MOST_STEPS} are possible",
        )


def check_virtual_pi(pi: VirtualPiSettings) -> None:
    """The virtual Pi can be built."""
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
        raise Problem(
            ("virtual_pi", "channel_y"), f"'{pi.channel_y}' is what channel_x is wired to"
        )
