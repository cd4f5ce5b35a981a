"""Measurement of a board: its parts in their order, the report, and the drawing of the wires."""

import errno
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path

import click
import msgspec

from fishd import __version__
from fishd.cli.doctor.base import Context
from fishd.cli.doctor.bench import analog, pulses, swim
from fishd.cli.doctor.bench.report import BenchReport, Board, Finding, page
from fishd.cli.doctor.bench.swim import Bench
from fishd.cli.doctor.computer import read_throttled
from fishd.cli.output import echo, print_json
from fishd.core.clock import SystemClock
from fishd.core.errors import ConfigError, FishError, ServoError, StartupError
from fishd.core.files import os_errors, write_atomically
from fishd.core.process.interruption import raise_on_first_signal
from fishd.hardware.checks import Result, ok, skipped, warning
from fishd.hardware.force_sensor.ads1115 import Ads1115Settings
from fishd.hardware.i2c import explain, read_bit_rate
from fishd.hardware.registry import SERVOS, driver_packages
from fishd.hardware.servo.pigpio import PigpioSettings
from fishd.hardware.servo.pulses import pulse_width, reach

HEADER_PINS = {
    2: 3,
    3: 5,
    4: 7,
    14: 8,
    15: 10,
    17: 11,
    18: 12,
    27: 13,
    22: 15,
    23: 16,
    24: 18,
    10: 19,
    9: 21,
    25: 22,
    11: 23,
    8: 24,
    7: 26,
    0: 27,
    1: 28,
    5: 29,
    6: 31,
    12: 32,
    13: 33,
    19: 35,
    16: 36,
    26: 37,
    20: 38,
    21: 40,
}
"""Pin of the 40-pin header by GPIO."""
BUSY_PINS = (0, 1, 2, 3, 14, 15)
"""GPIOs of buses, which change for other reasons."""
WIDTHS = 5
"""Number of duties of the filter."""
_PROCESSOR_ZONES = ("cpu-thermal", "x86_pkg_temp")
"""Types of the kernel's thermal zones that measure a processor; their numbers change."""
_PACKAGES = (
    *("msgspec", "numpy", "pyzmq", "pigpio", "gpiod", "rpi-lgpio", "RPi.GPIO", "Adafruit-Blinka"),
    *("adafruit-circuitpython-ads1x15", "adafruit-extended-bus"),
)
Print = Callable[[str, Result], None]


def check_wiring(context: Context, loop_gpio: int) -> None:
    """Raise `ConfigError` where the bench is impossible with this robot, or with this pin."""
    config = context.config
    if not config.kind.has_hardware:
        raise ConfigError(
            f"robot: {config.robot} has no board to measure: robot: pi or virtual-pi is needed"
        )
    used: dict[int | None, str] = {
        swim.find_servo_gpio(context): "servo.gpio",
        config.panel.estop_gpio: "panel.estop_gpio",
        config.panel.led_gpio: "panel.led_gpio",
    }
    if loop_gpio in used or loop_gpio in BUSY_PINS:
        raise ConfigError(
            f"--loop-gpio {loop_gpio}: {used.get(loop_gpio, 'a bus')} uses this pin; a free one is "
            "needed"
        )


def drawing(context: Context, loop_gpio: int) -> str:
    """Return a drawing of the two wires."""
    servo = swim.find_servo_gpio(context)
    pins = f"pin {HEADER_PINS[servo]} (GPIO {servo}, the servo's)"
    loop = f"pin {HEADER_PINS[loop_gpio]} (GPIO {loop_gpio})"
    return f"""\
Unplug the servo, and take the amplifier off A0 of the ADS1115. Then two wires:

   {pins} ---+------------------ {loop}
   {" " * len(pins)}    |
   {" " * len(pins)}    +---[ 10 kΩ ]---+-- A0 of the ADS1115
   {" " * len(pins)}                    |
   {" " * len(pins)}                 [ 10 µF ]  (the plus end at A0)
   {" " * len(pins)}                    |
   {"GND of the Pi":<{len(pins)}} -------------------+-- GND of the ADS1115

A part whose wire is missing is left out, and the report says so."""


def run(bench: Bench, output: Path, print_line: Print | None) -> int:
    """Measure the board, write the report, and return the exit status.

    print_line: prints each result; None prints the whole report as JSON at the end
    """
    context = bench.context
    now = datetime.now(UTC)
    stem = output / f"fishd-bench-{now:%Y%m%d-%H%M%S}"
    report = BenchReport(f"{now:%Y-%m-%d}", describe_board(context))
    unwritable = f"--to {output}: cannot be written"
    with os_errors(ConfigError, unwritable):  # before the measurement, not after it
        output.mkdir(parents=True, exist_ok=True)
        if not os.access(output, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    with raise_on_first_signal():
        for name, result in _measure(bench, report):
            report.findings.append(Finding(name, *result))
            if print_line:
                print_line(name, result)
    report.board = msgspec.structs.replace(report.board, temperature=_temperature(context))
    with os_errors(ConfigError, unwritable):
        data = msgspec.json.format(msgspec.json.encode(report), indent=1)
        write_atomically(stem.with_suffix(".json"), data + b"\n", new=True)
        write_atomically(stem.with_suffix(".md"), page(report), new=True)
    if print_line:
        echo(f"{stem}.json and {stem}.md: written; send both, see docs/how-to/bench.md")
    else:
        print_json(report)
    return int(any(finding.level == "FAIL" for finding in report.findings))


def _measure(bench: Bench, report: BenchReport) -> Iterator[tuple[str, Result]]:
    board = report.board
    real_time = "PREEMPT_RT" if board.preempt_rt else "no PREEMPT_RT"
    yield "board", ok(f"{board.model or 'unknown'}, kernel {board.kernel}, {real_time}")
    yield from _measure_adc(bench, report)
    yield from _measure_pulses(bench, report)


def _measure_adc(bench: Bench, report: BenchReport) -> Iterator[tuple[str, Result]]:
    context = bench.context
    settings = context.config.force_sensor
    if not isinstance(settings, Ads1115Settings):
        message = f"force_sensor.driver: {settings.driver} is not measured, only ads1115 is"
        yield "adc and bus", skipped(message)
        return
    try:
        with driver_packages(settings.driver):
            import adafruit_extended_bus  # noqa: F401
        with context.plugged_in():
            configured: float | None = read_bit_rate(context, settings.bus)
            if context.is_virtual:
                configured = context.config.virtual_pi.bus_speed
            with analog.open_bus(settings) as bus:
                report.bus = analog.measure_bus(bus, settings.address, configured)
            yield "i2c speed", analog.judge_bus(report.bus)
            yield "adc clock", analog.judge_conversion(report.bus)
            yield "adc and pulses", _measure_filter(bench, report, settings)
    except (OSError, StartupError) as error:
        if isinstance(error, StartupError):
            why = str(error)
        else:
            why = explain(error, settings.bus, settings.address, "ADS1115", "force_sensor")
        yield "adc and bus", warning(f"not measured: {why}", "see fishctl doctor without --bench")


def _measure_filter(bench: Bench, report: BenchReport, settings: Ads1115Settings) -> Result:
    from fishd.hardware.force_sensor.ads1115_single_shot import SingleShot

    config, servo_settings = bench.context.config, bench.context.config.servo
    lowest, highest = (pulse_width(servo_settings, angle) for angle in reach(servo_settings))
    step = (highest - lowest) / (WIDTHS - 1)
    widths = [10.0 * round((lowest + index * step) / 10.0) for index in range(WIDTHS)]
    widths.sort(reverse=True)
    frame = 1.0 / getattr(servo_settings, "frequency", 50.0)
    neutral = pulse_width(servo_settings, 0.0)
    if isinstance(servo_settings, PigpioSettings):  # this program has no real-time priority
        servo_settings = msgspec.structs.replace(servo_settings, timeout=0.1, countdown=2.0)
    clock = SystemClock()
    try:
        with ExitStack() as stack:
            bus = stack.enter_context(analog.open_bus(settings))
            bus.unlock()
            chip = SingleShot(bus, settings.address, analog.FULL_SCALE_V, settings.data_rate, clock)
            a0 = chip.input("A0")
            with driver_packages(servo_settings.driver):
                kind = SERVOS.find(servo_settings.driver)
                servo = kind(servo_settings, neutral, clock, tick=config.tick, threaded=True)
            stack.callback(servo.close)
            result = analog.measure_filter(
                lambda: float(a0.voltage), servo.write, widths, frame, config.tick
            )
    except ServoError as error:
        return warning(f"not measured: {error}", "see fishctl doctor without --bench")
    if isinstance(result, Result):
        return result
    report.filter = result
    return analog.judge_filter(result)


def _measure_pulses(bench: Bench, report: BenchReport) -> Iterator[tuple[str, Result]]:
    settings = bench.context.config.servo
    if not isinstance(settings, PigpioSettings):
        message = f"servo.driver: {settings.driver}: only pulses of pigpiod are measured"
        yield "pulses", skipped(message)
        return
    gpios = [gpio for gpio in HEADER_PINS if gpio not in BUSY_PINS]
    gpios += [] if settings.gpio in gpios else [settings.gpio]
    try:
        with driver_packages(settings.driver):
            from fishd.hardware.servo.pigpio_edges import open_edges
            from fishd.hardware.servo.pigpio_pulses import COUNT_S, countdown_counts
        tick = bench.context.config.tick
        report.countdown = COUNT_S * countdown_counts(settings.countdown, tick)
        with open_edges(settings.host, settings.port, gpios) as edges:
            swim.measure(bench, edges, report)
    except swim.MissingWire as error:
        yield "pulses", warning(str(error), "connect the wire as drawn, and start again")
    except (FishError, StartupError, ServoError) as error:
        yield "pulses", warning(f"not measured: {error}", "see fishctl doctor without --bench")
    if report.held:
        yield "pulses held", pulses.judge(report.held)
    if report.swimming:
        yield "pulses swum", pulses.judge(report.swimming)
    if report.lateness:
        yield "lateness", _judge_lateness(report)
    if report.stopped:
        yield "stop", pulses.judge_ending(report.stopped, bench.context.config.fade_time, "SIGTERM")
    if report.killed:
        yield "kill", pulses.judge_ending(report.killed, report.countdown or 0.0, "SIGKILL")


def _judge_lateness(report: BenchReport) -> Result:
    late = report.lateness
    assert late
    scheduling = f"SCHED_FIFO {late.priority}" if late.priority else "the normal scheduler"
    message = (
        f"ticks of {late.tick * 1e3:g} ms under {scheduling} came late by {late.fishd[0]:.0f} µs "
        f"(median), {late.fishd[1]:.0f} (99 %), {late.fishd[2]:.0f} (at most)"
    )
    if late.cyclictest is None:
        return ok(f"{message}; cyclictest is not installed (sudo apt install rt-tests) or failed")
    median, p99, worst = late.cyclictest
    return ok(f"{message}; cyclictest in the same time {median:.0f}, {p99:.0f}, {worst:.0f}")


def describe_board(context: Context) -> Board:
    """Return the properties of the board and its software."""
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    kernel = os.uname()
    cpus = context.path("/sys/devices/system/cpu").glob("cpu[0-9]*/cpufreq/scaling_governor")
    governors = {path.read_text().strip() for path in cpus}
    lines = context.text("/etc/os-release").splitlines()
    names = [line.partition("=")[2].strip('"') for line in lines if line.startswith("PRETTY_NAME=")]
    return Board(
        model="virtual Pi" if context.is_virtual else context.model,
        architecture=f"{kernel.machine}, {platform.architecture()[0]}",
        system=names[0] if names else "unknown system",
        kernel=kernel.release,
        preempt_rt="PREEMPT_RT" in kernel.version or context.text("/sys/kernel/realtime") == "1",
        governor=", ".join(sorted(governors)),
        throttled=read_throttled(context),
        temperature=_temperature(context),
        python=platform.python_version(),
        fishd=__version__,
        packages=versions,
        drivers={driver.section: driver.name for driver in context.drivers},
    )


def _temperature(context: Context) -> float | None:
    """Return the temperature of the processor [°C], by the name of its sensor."""
    zones = "/sys/class/thermal"
    for zone in sorted(context.path(zones).glob("thermal_zone*")):
        if context.text(f"{zones}/{zone.name}/type") in _PROCESSOR_ZONES:
            text = context.text(f"{zones}/{zone.name}/temp")
            return int(text) / 1000.0 if text.lstrip("-").isdigit() else None
    return None


def confirm(context: Context, loop_gpio: int) -> None:
    """Show the drawing, and end the program unless the user confirms the wiring."""
    echo(drawing(context, loop_gpio), err=True)
    click.confirm("Is the servo unplugged, and are the wires in?", abort=True, err=True)
