"""Checks of the robot's drivers: their own, those that are the same for all, and their pins.

While a fishd runs, they ask it and leave its hardware alone.
"""

import os
import re
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, closing
from typing import Any

from fishd.assembly import open_sensor
from fishd.cli.doctor.base import ChosenDriver, Context
from fishd.config.drivers import claims_of
from fishd.core.clock import SystemClock
from fishd.core.console import format_reading
from fishd.core.errors import ConfigError, MissingPackage, SensorError, ServoError, StartupError
from fishd.hardware.checks import (
    START_VIRTUAL_PI,
    Check,
    Result,
    fail,
    ok,
    on_this_machine,
    skipped,
    warning,
)
from fishd.hardware.driver import SensorDriver
from fishd.hardware.force_sensor.sampled_sensor import SampledSensor
from fishd.hardware.registry import FORCE_SENSORS, SERVOS, driver_packages
from fishd.hardware.servo import pulses

TRIAL_S = 1.0
"""Duration of the trial of the force sensor [s]."""
SENSOR_TIMEOUT_S = 5.0
"""Longest wait for the first sample of another sensor [s]."""
_DEBUG = "/sys/kernel/debug"
_GPIO_LINE = re.compile(r"\(GPIO(?P<pin>\d+)\s*\|(?P<user>[^)]*?)\s*\)")


def checks(context: Context) -> tuple[Check, ...]:
    """Return all checks, for the drivers of the configuration."""
    sensor, servo, *others = context.drivers
    return (
        Check("drivers", drivers),
        *sensor.find().checks(sensor.settings),
        Check("force", force),
        *(servo.find().checks(servo.settings) or (Check("servo", servo_opens),)),
        *(check for other in others for check in other.find().checks(other.settings)),
        *map(_sensor_check, others),
        Check("gpio pins", pins, on_this_machine),
    )


def _sensor_check(sensor: ChosenDriver) -> Check:
    """Return the check that a sensor gives readings."""
    name = sensor.section.partition(".")[2]
    return Check(name, lambda context: _sensor_answers(context, name, sensor))


def _sensor_answers(context: Context, name: str, sensor: ChosenDriver) -> Result:
    """Check that a sensor gives readings, by the running daemon or by its driver."""
    if context.running:
        states = {key: s for key, s in context.running[0].readings.items() if s.sensor == name}
        problems = [state.problem for state in states.values() if state.problem]
        values = [f"{key} {format_reading(s)}" for key, s in states.items() if s.value is not None]
        if problems:
            return fail(problems[0], "mend what this line says")
        return ok(", ".join(values))
    if occupied := context.occupied("reads it"):
        return occupied
    with driver_packages(sensor.name):
        driver = sensor.find()(sensor.settings, SystemClock(), context.config.tick, sensor.section)
    try:
        with context.plugged_in(), closing(driver):
            driver.open()
            result: Result = driver.judge(_first_sample(driver))
            return result
    except StartupError as error:
        return fail(str(error), START_VIRTUAL_PI)
    except Exception as error:  # the libraries of drivers raise all kinds of exceptions
        return fail(driver.explain(error), "mend what this line says")


def _first_sample(driver: SensorDriver[Any]) -> Mapping[str, float]:
    """Return the first sample of a sensor; raise TimeoutError if none is complete in time."""
    start = time.monotonic()
    while time.monotonic() - start < SENSOR_TIMEOUT_S:
        if sample := driver.sample():
            return sample
        time.sleep(0.01)
    raise TimeoutError(f"{driver.place} gave no sample for {SENSOR_TIMEOUT_S:g} s")


def drivers(context: Context) -> Result:
    """Report each driver, and its package."""
    return ok(
        ", ".join(
            f"{driver.section} {driver.name} of {driver.plugins.package(driver.name)}"
            for driver in context.drivers
        )
    )


def servo_opens(context: Context) -> Result:
    """Check that a servo driver that defines no checks can be opened; no pulses begin."""
    if occupied := context.occupied("drives the servo; see daemon"):
        return occupied
    settings, tick = context.config.servo, context.config.tick
    neutral = pulses.pulse_width(settings, 0.0)
    with context.plugged_in(), driver_packages(settings.driver):
        servo = SERVOS.find(settings.driver)(
            settings, neutral, SystemClock(), tick=tick, threaded=True
        )
        try:
            servo.close()
        except ServoError as error:
            return fail(str(error), "check its wires and its supply")
    return ok(f"driver {settings.driver} opens")


def force(context: Context) -> Result:
    """Check the measurements of the running daemon, or of the driver for a second."""
    if context.running:
        return _check_force_of_daemon(context)
    if occupied := context.occupied("owns the sensor"):
        return occupied
    config = context.config
    try:
        with context.plugged_in(), ExitStack() as stack:
            sensor = open_sensor(config, SystemClock(), threaded=True)
            stack.callback(sensor.close)
            trials = list(_trial_windows(sensor, config.tick))
    except MissingPackage:
        raise
    except (ConfigError, StartupError) as error:
        remedy = START_VIRTUAL_PI if context.is_virtual else "mend what this line says"
        return fail(str(error), remedy)
    except SensorError as error:
        return fail(str(error), "mend what the lines above say first")
    suspicions = [suspicion for _, suspicion in trials if suspicion]
    per_tick = sum(count for count, _ in trials) / len(trials)
    if not per_tick:
        return fail("the sensor answers, but delivers nothing", "switch its power off and on")
    if suspicions:
        return fail(
            f"suspect in {len(suspicions)} of {len(trials)} ticks: {suspicions[-1]}",
            "check the wires of the sensor, its amplifier, and its range",
        )
    return _judge_rate(per_tick, context, "not clipped, not frozen")


def _check_force_of_daemon(context: Context) -> Result:
    assert context.running
    status, tick, *_ = context.running
    if tick is None:
        return fail(f"fishd runs, but {status.telemetry} is silent", "fishctl status; a firewall?")
    if status.reason and status.reason.code.startswith("sensor"):
        return fail(
            f"{status.reason.code}: {status.reason.message}",
            "mend the cause, then fishctl clear-fault",
        )
    transport = FORCE_SENSORS.find(context.config.force_sensor.driver).transport
    errors = ", ".join(
        f"{n} {name}"
        for name, n in status.recovered_errors.items()
        if name.startswith(transport) and n
    )
    if tick.samples == 0:
        return warning(
            f"no new sample in the latest tick, the newest is {tick.sample_age_ms:.0f} ms old",
            "fishctl watch; check the wires if this goes on",
        )
    return _judge_rate(
        tick.samples,
        context,
        f"the newest {tick.sample_age_ms:.0f} ms old, {errors or 'no errors'}",
    )


def _judge_rate(per_tick: float, context: Context, details: str) -> Result:
    """Compare the sample rate with that of a healthy bus at this data rate and tick."""
    config = context.config
    driver = FORCE_SENSORS.find(config.force_sensor.driver)
    expected = driver.pair_rate(config.force_sensor) * config.tick
    message = f"{per_tick:.1f} pairs of samples per tick, {details}"
    if per_tick < expected:
        return warning(
            f"{message}: fewer than the {expected:.1f} that driver {config.force_sensor.driver} "
            "gives where all is well",
            "make its bus faster, and stop what else uses it or loads the processor",
        )
    return ok(message)


def _trial_windows(sensor: SampledSensor, tick: float) -> Iterator[tuple[int, str | None]]:
    """Yield samples and suspicion of each window, without the first, when the sampler starts."""
    latest: SensorError | None = None
    start = time.monotonic()
    first = True
    while time.monotonic() - start < TRIAL_S:
        time.sleep(tick)
        try:
            measurement = sensor.read(time.monotonic())
        except SensorError as error:
            latest = error
            continue
        if not first:
            yield measurement.samples, measurement.suspect
        first, latest = False, None
    if latest or first:
        raise latest or SensorError("the sensor says nothing")


def pins(context: Context) -> Result | None:
    """Check that no program holds the configured pins, as far as the kernel knows."""
    config = context.config
    configured = {
        config.panel.estop_gpio: "panel.estop_gpio",
        config.panel.led_gpio: "panel.led_gpio",
    }
    configured |= {
        pin: f"{section}.{claim.key}"
        for section, claims in claims_of(config.driver_settings).items()
        for claim in claims
        for pin in claim.pins
        if claim.key != "bus"  # the kernel drives the pins of a bus
    }
    configured.pop(None, None)
    text = context.text(f"{_DEBUG}/gpio")
    if not text:
        return skipped(_explain_unseen(context))
    if occupied := context.occupied("uses its pins"):
        return occupied
    users = {int(match["pin"]): match["user"].strip() for match in _GPIO_LINE.finditer(text)}
    conflicts = [
        f"GPIO{pin} ({key}) is used by {users[pin]}"
        for pin, key in configured.items()
        if pin is not None and users.get(pin)
    ]
    if conflicts:
        return warning(
            "; ".join(conflicts), "stop that program, remove its dtoverlay, or choose another pin"
        )
    return ok(", ".join(f"GPIO{pin}" for pin in configured) + " free")


def _explain_unseen(context: Context) -> str:
    if os.geteuid() != 0:
        return "only root can see who uses GPIO pins: sudo fishctl doctor"
    try:
        mounted = any(context.path(_DEBUG).iterdir())
    except OSError as error:
        return f"who uses GPIO pins cannot be seen: {_DEBUG}: {error.strerror}"
    if mounted:
        return f"this kernel does not say who uses GPIO pins: there is no {_DEBUG}/gpio"
    return (
        f"who uses GPIO pins cannot be seen, debugfs is not mounted: mount -t debugfs none {_DEBUG}"
    )
