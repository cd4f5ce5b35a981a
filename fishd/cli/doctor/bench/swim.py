"""Measurement of the pulses of a separate fishd that swims, is stopped and is killed."""

import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

from fishd.cli.doctor.base import Context
from fishd.cli.doctor.bench import cyclictest
from fishd.cli.doctor.bench.pulses import Pulse, find_ending, find_p99, find_pulses, summarise
from fishd.cli.doctor.bench.report import BenchReport, Ending, Lateness
from fishd.client import Fish
from fishd.core.errors import ConfigError, FishError, NoDaemon, StartupError
from fishd.core.process.safe_path import python_command
from fishd.core.signals import Status, Tick
from fishd.hardware.servo import pulses

if TYPE_CHECKING:  # it needs pigpio
    from fishd.hardware.servo.pigpio_edges import Edge, EdgeReader

START_TIMEOUT_S = 60.0
"""Longest start of fishd, on the slowest board [s]."""
STOP_TIMEOUT_S = 30.0
"""Longest time that fishd takes to end [s]."""
ANSWER_TIMEOUT_S = 5.0
"""Longest answer of fishd [s]."""
BEAT_HZ = 1.0
"""Frequency of the square wave."""
MIN_PULSES = 3
"""Smallest number of pulses that tells that a pin is connected."""
_SENSOR = (
    "force_sensor.force_limit=100",
    "force_sensor.frozen_after=null",
)
_ADS1115 = (
    "force_sensor.full_scale=4.096",
    "force_sensor.saturation_low=null",
    "force_sensor.saturation_high=null",
)
"""Settings with which neither an open input nor the filter is a fault."""


class MissingWire(Exception):
    """The looped pin has no pulses; the message says why."""


class Bench(NamedTuple):
    """Robot, wires and length of a measurement."""

    context: Context
    overrides: tuple[str, ...]
    loop_gpio: int
    seconds: float
    """Length of the swim [s]."""


def find_servo_gpio(context: Context) -> int:
    """Return the servo's pin; raise `ConfigError` if its driver has none on the header."""
    gpio = getattr(context.config.servo, "gpio", None)
    if gpio is None:
        raise ConfigError(
            f"servo.driver: {context.config.servo.driver} has no pin of the Pi's header to measure"
        )
    return int(gpio)


@contextmanager
def separate_fishd(bench: Bench) -> Iterator[tuple[subprocess.Popen[bytes], Fish]]:
    """Run a separate fishd; raise `StartupError` with its last line."""
    config = bench.context.config
    with TemporaryDirectory(prefix="fishd-bench-", ignore_cleanup_errors=True) as folder:
        endpoint = f"ipc://{folder}/control"
        own = [f"control.address={endpoint}", "telemetry.address=tcp://127.0.0.1:0"]
        own += ["start.controller=null", "start.parameters={}", "start.rest=0", *_SENSOR]
        own += _ADS1115 if config.force_sensor.driver == "ads1115" else ()
        command = python_command("-m", "fishd")
        command += ["--config", str(bench.context.file)] if bench.context.file else []
        for override in (*bench.overrides, *own):
            command += ["--set", override]
        log = Path(folder) / "log"
        with log.open("wb") as output:
            process = subprocess.Popen(command, stdout=output, stderr=output)
        try:
            with Fish(endpoint, timeout=ANSWER_TIMEOUT_S) as fish:
                _await_start(process, fish, log)
                yield process, fish
        finally:
            process.kill()
            process.wait()


def _await_start(process: subprocess.Popen[bytes], fish: Fish, log: Path) -> Status:
    """Wait until fishd holds the servo at neutral."""
    deadline = time.monotonic() + START_TIMEOUT_S
    status = None
    while time.monotonic() < deadline and process.poll() is None:
        with suppress(NoDaemon):
            status = fish.status()
            if status.servo_on and status.mode == "idle":
                return status
            if status.mode == "fault":
                with suppress(FishError):
                    fish.clear_fault()
        time.sleep(0.1)
    lines = log.read_text(errors="replace").splitlines()
    why = status.reason.message if status and status.reason else lines[-1] if lines else "no answer"
    raise StartupError(f"the fishd of this measurement does not run: {why}")


def measure(bench: Bench, edges: "EdgeReader", report: BenchReport) -> None:
    """Hold, swim and stop a fishd, then swim and kill another one; fill the report.

    Raises `MissingWire` and `FishError`.
    """
    servo = bench.context.config.servo
    with separate_fishd(bench) as (process, fish):
        used = servo.calibrated(fish.calibrations().servo)
        neutral = float(round(pulses.pulse_width(used, 0.0)))
        edges.take()
        time.sleep(max(0.5, bench.seconds / 2))
        held = _loop_pulses(bench, edges.take())
        report.held = summarise(held, [neutral])
        ticks, report.lateness = _swim(bench, fish)
        sent = {float(round(pulses.pulse_width(used, tick.phi_c))) for tick in ticks} | {neutral}
        report.swimming = summarise(_loop_pulses(bench, edges.take()), sorted(sent))
        stopped = edges.now()
        process.terminate()
        process.wait(STOP_TIMEOUT_S)
        report.stopped = _watch_ending(bench, edges, neutral, stopped, report)
    with separate_fishd(bench) as (process, fish):
        edges.take()
        fish.set_controller("square", frequency=BEAT_HZ)
        _swim_for(fish, 0.3)
        process.kill()
        process.wait()
        report.killed = _watch_ending(bench, edges, neutral, edges.now(), report)


def _swim(bench: Bench, fish: Fish) -> tuple[list[Tick], Lateness]:
    """Swim a square wave beside cyclictest; return the ticks."""
    status = fish.status()
    priority = bench.context.config.realtime.priority if status.realtime else 0
    rival = None
    if shutil.which("cyclictest"):
        command = cyclictest.command(status.tick, bench.seconds, priority)
        rival = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
    try:
        fish.set_controller("square", frequency=BEAT_HZ)
        ticks = _swim_for(fish, bench.seconds)
        late: list[float] = []
        if rival:
            late, _ = cyclictest.parse(rival.communicate(timeout=bench.seconds + 30.0)[0])
    finally:
        if rival:
            rival.kill()
            rival.communicate()
    return ticks, Lateness(
        bench.seconds,
        status.tick,
        priority,
        _percentiles([tick.lateness_us for tick in ticks]),
        _percentiles([1e6 * seconds for seconds in late]) if late else None,
    )


def _swim_for(fish: Fish, seconds: float) -> list[Tick]:
    """Return the ticks of a swim that has begun; raise `StartupError` where it ends early."""
    ticks: list[Tick] = []
    for tick in fish.ticks():
        if tick.mode != "running":
            reason = fish.status().reason
            raise StartupError(f"fishd swims no more: {reason.message if reason else tick.mode}")
        ticks.append(tick)
        if tick.time - ticks[0].time >= seconds:
            break
    return ticks


def _percentiles(values: list[float]) -> tuple[float, float, float]:
    ordered = sorted(values)
    return ordered[(len(ordered) - 1) // 2], find_p99(ordered), ordered[-1]


def _loop_pulses(bench: Bench, edges: "dict[int, list[Edge]]") -> list[Pulse]:
    """Return the pulses on the looped pin; raise `MissingWire` if there are none."""
    looped = find_pulses(edges[bench.loop_gpio])
    if len(looped) >= MIN_PULSES:
        return looped
    servo_gpio = find_servo_gpio(bench.context)
    sent = len(edges[servo_gpio])
    if sent < 2 * MIN_PULSES:
        raise MissingWire(f"pigpiod reports no pulses on GPIO {servo_gpio}, the servo's pin")
    for gpio, of_pin in edges.items():
        if gpio not in (servo_gpio, bench.loop_gpio) and abs(len(of_pin) - sent) <= 2:
            raise MissingWire(
                f"the wire leads to GPIO {gpio} instead of GPIO {bench.loop_gpio}: move it, or "
                f"give --loop-gpio {gpio}"
            )
    raise MissingWire(
        f"no pulses arrive at GPIO {bench.loop_gpio}: no wire leads to it from GPIO {servo_gpio}"
    )


def _watch_ending(
    bench: Bench, edges: "EdgeReader", neutral: float, end: float, report: BenchReport
) -> Ending:
    """Wait for longer than the pulses may last after `end` [s]; return how they ended."""
    time.sleep((report.countdown or 0.0) + 1.0)
    now = edges.now()
    return find_ending(find_pulses(edges.take()[bench.loop_gpio]), neutral, end, now)
