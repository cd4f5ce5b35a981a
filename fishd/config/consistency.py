"""What no single key can tell: values of a configuration that do not go together.

Each check raises `Problem` with the key to blame and what would be right.
"""

import math
import re
from collections.abc import Mapping
from typing import Any

from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.emulation.settings import VirtualPiSettings
from fishd.errors import ParameterError, UnknownController
from fishd.hardware import pulses
from fishd.hardware.settings import (
    FULL_SCALES,
    ForceSensorSettings,
    PanelSettings,
    ServoSettings,
)
from fishd.schema import Problem
from fishd.zmq_address import FORM, check_length, is_local, why_not_served

REMOVED = {
    ("servo", "pigpio", "hardware_pwm"): "this key is gone, as such pulses outlive pigpiod and "
    "nothing ended them; for finer pulses or more than 50 Hz write servo.driver: sysfs-pwm, on the "
    "same pins, else leave the key out",
}
"""Keys that older versions had, and what to write instead."""
SLOWEST_CONVERSION = 1.25
"""Of the ADC with its tolerance and its transfers, in units of 1 / data rate."""
I2C_PINS = (2, 3)
"""SDA and SCL of bus 1."""


def check_removed(data: Mapping[str, Any]) -> None:
    """Nothing is asked for that there is no more; data: the file, with overrides."""
    for path, instead in REMOVED.items():
        section: Any = data
        for key in path[:-1]:
            section = section.get(key) if isinstance(section, Mapping) else None
        if isinstance(section, Mapping) and path[-1] in section:
            raise Problem(path, instead)


def check_start(controller: str | None, parameters: Mapping[str, Any], limits: Limits) -> None:
    """The controller to start with is there and takes its parameters."""
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
    """Both are addresses, not the same, and requests come from this machine only."""
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


def check_data_rate(sensor: ForceSensorSettings, tick: float) -> None:
    """A pair of samples comes in each tick [s]."""
    slowest = 2 * SLOWEST_CONVERSION / sensor.data_rate
    if slowest > tick:
        raise Problem(
            ("force_sensor", "data_rate"),
            f"{sensor.data_rate} is not valid: a pair of samples would take up to "
            f"{slowest * 1e3:.1f} ms, longer than a tick of {tick * 1e3:g} ms",
        )


def check_force_sensor(sensor: ForceSensorSettings) -> None:
    """The ADC has the range, and each force an input of its own."""
    if sensor.full_scale not in FULL_SCALES:
        permitted = ", ".join(f"{scale:g}" for scale in FULL_SCALES)
        raise Problem(
            ("force_sensor", "full_scale"),
            f"{sensor.full_scale:g} is not valid: one of {permitted} V is needed",
        )
    low, high = sensor.saturation_low, sensor.saturation_high
    if low is not None and high is not None and low >= high:
        raise Problem(
            ("force_sensor", "saturation_low"),
            f"{low:g} is not valid: less than saturation_high, {high:g} V, is needed",
        )
    if sensor.channel_x == sensor.channel_y:
        raise Problem(
            ("force_sensor", "channel_y"), f"'{sensor.channel_y}' is what channel_x is wired to"
        )


def check_servo(servo: ServoSettings, amplitude: float) -> None:
    """Each angle within ±Φ [rad] has a pulse, and the driver can send it on that pin."""
    check_neutral(servo)
    check_pulses(servo, amplitude)
    if not re.fullmatch(r"\S+", servo.pigpio.host):
        raise Problem(
            ("servo", "pigpio", "host"),
            f"'{servo.pigpio.host}' is not valid: a host is needed, such as 127.0.0.1",
        )
    if servo.driver == "pigpio" and servo.frequency != 50.0:
        raise Problem(
            ("servo", "frequency"),
            f"{servo.frequency:g} is not valid: pigpiod's servo pulses come at 50 Hz; for others "
            "set servo.driver: sysfs-pwm",
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
    possible = pulses.widest(servo)
    if possible[0] <= wanted[0] + pulses.ROUNDING and wanted[1] - pulses.ROUNDING <= possible[1]:
        return
    neutral = servo.centre + servo.trim
    below, above = sorted(servo.direction * servo.scale * angle for angle in wanted)
    lowest, highest = pulses.SHORTEST - below, pulses.LONGEST - above
    if lowest > highest:
        key = "scale"
        most = (pulses.LONGEST - pulses.SHORTEST) / (wanted[1] - wanted[0])
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


def check_pins(sensor: ForceSensorSettings, servo: ServoSettings, panel: PanelSettings) -> None:
    """No pin has two jobs."""
    jobs = dict.fromkeys(I2C_PINS, "the I2C bus") if sensor.bus == 1 else {}
    for section, name, pin in (
        ("servo", "gpio", servo.gpio),
        ("panel", "estop_gpio", panel.estop_gpio),
        ("panel", "led_gpio", panel.led_gpio),
    ):
        if pin is None:
            continue
        if pin in jobs:
            raise Problem((section, name), f"{pin} is the pin of {jobs[pin]} already")
        jobs[pin] = f"{section}.{name}"


def check_lockstep(robot: str, lockstep: bool) -> None:
    """Only a fish that is simulated can wait."""
    if lockstep and robot != "simulated":
        raise Problem(
            ("lockstep",),
            f"true is not valid with robot: {robot}, whose time cannot stand still; "
            "robot: simulated is needed",
        )


def check_virtual_pi(robot: str, servo: ServoSettings, pi: VirtualPiSettings) -> None:
    """The virtual Pi can be built, and has what the servo needs."""
    if robot == "virtual-pi" and servo.driver != "pigpio":
        raise Problem(
            ("servo", "driver"),
            f"'{servo.driver}' is not valid: the virtual Pi has pigpiod, and no other pulses",
        )
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
