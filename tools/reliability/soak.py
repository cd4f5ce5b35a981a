"""Long runs of fishd in virtual time with random failures of everything around it.

    simulated    the loop, with a robot that fails in all ways
    virtual-pi   the whole hardware path, with injected faults
    channels     wrong-channel values with 1 % I2C errors

Each ends with a line of figures, and with exit status 1 if a promise was broken: an exception that
got out of a tick, an angle beyond the limits, pulses that go on in fault or estop, memory that
grows, a value of the wrong channel.

Memory counts after the first fifth of a run. In a run of the default length it may grow by less
than 1 MB. In a shorter run this would measure the warm-up of the interpreter. All runs are
therefore also checked for objects that remain from every tick, in both halves of the rest, which
does not detect leaks below a record per tick.
"""

import gc
import itertools
import logging
import math
import random
import sys
import tempfile
import time
from argparse import Namespace
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from common.report import BrokenPromise, Options, Report, progress
from fishd.assembly import build_loop, open_in_virtual_time, simulated_fish
from fishd.config import Config, load
from fishd.control.loop import ControlLoop
from fishd.core.calibration import ForceCalibration
from fishd.core.clock import Slot, VirtualClock, virtual_slots
from fishd.core.errors import SensorError
from fishd.hardware.force_sensor.ads1115 import Ads1115, Ads1115Settings
from fishd.hardware.force_sensor.sampled_sensor import SampledSensor
from fishd.virtual.pi.ads1115 import Ads1115Chip
from fishd.virtual.pi.faults import FAULTS, INSTANTANEOUS, Faults
from fishd.virtual.pi.i2c import I2cBus
from fishd.virtual.pi.linux_i2c import LinuxI2c
from reliability.soak_troubles import Counting, Rest, Saboteur, misuse

SIMULATED_TICKS = 1_000_000
VIRTUAL_PI_TICKS = 20_000
PAGE = 4096
MAX_GROWTH_MB = 1.0
"""Largest growth of memory [MB]."""
LEAK = 2.0
"""Remaining objects per tick, in both halves, that count as a leak; a record has more objects.

The history of the pulses and the caches of the plant are bounded, but still grow in a short run, by
about half an object per tick on a virtual Pi.
"""
LOOKS = (0.2, 0.6, 1.0)
"""Times of the measurements, as fractions of a run."""


class Memory:
    """Memory of this process at three times of a run."""

    def __init__(self, ticks: int, long_run: int) -> None:
        """`long_run`: number of ticks from which growth of memory is a leak and not the warm-up."""
        self._long = ticks >= long_run
        self._looks = {round(share * ticks): (0, 0) for share in LOOKS}

    def after(self, tick: int) -> None:
        """Record the memory; call it after every tick, counted from 1."""
        if tick not in self._looks:
            return
        gc.collect()
        resident = int(Path("/proc/self/statm").read_text().split()[1]) * PAGE
        self._looks[tick] = (sys.getallocatedblocks(), resident)

    def verdict(self, what: str) -> str:
        """Return a description of the growth; raises `BrokenPromise` for a leak."""
        (begin, middle, end), looks = self._looks, self._looks.values()
        blocks, resident = zip(*looks, strict=True)
        halves = (
            (blocks[1] - blocks[0]) / (middle - begin),
            (blocks[2] - blocks[1]) / (end - middle),
        )
        if min(halves) >= LEAK:
            raise BrokenPromise(f"{what}: {min(halves):.1f} objects are left behind per tick")
        growth = (resident[2] - resident[0]) / 1e6 if self._long else math.nan
        if growth >= MAX_GROWTH_MB:
            raise BrokenPromise(f"{what}: memory grew by {growth:.2f} MB")
        return f"memory {growth:+.2f} MB" if self._long else "no objects left behind"


def check(loop: ControlLoop) -> None:
    """Check that the current angle is within limits."""
    if not abs(loop.instruction_angle) <= 0.42 + 1e-9:
        raise BrokenPromise(f"tick {loop.seq}: the present angle is {loop.instruction_angle} rad")


def soak_simulated(ticks: int, seed: int) -> str:
    """Run the loop on a simulated fish whose robot, controllers and users misbehave."""
    dice = random.Random(seed)
    config = load(None, [f"simulation.seed={seed}"])
    clock = VirtualClock()
    fish = simulated_fish(config)
    saboteur = Saboteur(fish.robot(), dice)
    publisher = Counting(lambda: dice.random() < 1e-4)
    loop = build_loop(config, saboteur.robot(), clock, publisher)
    rest = Rest(loop)
    memory = Memory(ticks, long_run=SIMULATED_TICKS)
    index = 0
    for count in range(ticks):
        missed = dice.randrange(1, 5) if dice.random() < 0.002 else 0
        index += missed
        deadline = index * config.tick
        clock.now = deadline + (dice.expovariate(1e3) if missed else 0.0)
        loop.tick(Slot(index, deadline, clock.now, missed))
        index += 1
        check(loop)
        rest.check(saboteur.in_trouble, saboteur.servo_on)
        if dice.random() < 0.02:
            misuse(loop, dice)
        memory.after(count + 1)
    return verdict(f"simulated fish, {ticks} ticks", publisher, memory)


def soak_virtual_pi(ticks: int, seed: int) -> str:
    """Run the whole hardware path in virtual time, with faults injected by name."""
    dice = random.Random(seed)
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        config = virtual_pi_config(folder, seed)
        clock = VirtualClock()
        robot, pi = open_in_virtual_time(config, stack)
        publisher = Counting()
        loop = build_loop(config, robot, clock, publisher)
        rest = Rest(loop, patience=30)  # one attempt to connect to pigpiod takes up to ten ticks
        memory = Memory(ticks, long_run=VIRTUAL_PI_TICKS)
        injected: Counter[str] = Counter()
        last_fault = ticks - 30  # after it the connection is there again, which close() needs
        width_limits = (1500 - 600 * 0.42 - 6, 1500 + 600 * 0.42 + 6)
        for slot in itertools.islice(virtual_slots(clock, config.tick), ticks):
            loop.tick(slot)
            check(loop)
            width = pi.pigpiod.width(config.virtual_pi.servo_gpio, slot.deadline)
            if width and not width_limits[0] <= width <= width_limits[1]:
                raise BrokenPromise(f"tick {loop.seq}: the servo got a pulse of {width} µs")
            lost = any(pi.faults.active(name) for name in FAULTS if name.startswith("pigpiod"))
            rest.check(lost, width > 0.0)
            if slot.index < last_fault and dice.random() < 0.01:
                name = dice.choice(tuple(FAULTS))
                injected[name] += 1
                pi.faults.inject(
                    name, None if name in INSTANTANEOUS else dice.choice((0.02, 0.1, 0.5))
                )
            if dice.random() < 0.05:
                misuse(loop, dice)
            memory.after(slot.index + 1)
        counters = robot.counters()
    spelled = ", ".join(f"{count} {name}" for name, count in sorted(injected.items()))
    recovered = ", ".join(f"{count} {name}" for name, count in counters.items())
    line = verdict(f"virtual Pi, {ticks} ticks", publisher, memory)
    return f"{line}; injected: {spelled}; recovered from: {recovered}"


def soak_channels(reads: int, seed: int) -> str:
    """Check that two channels are never confused while 1 % of the transfers fail."""
    clock = VirtualClock()
    faults = Faults(clock, seed)
    faults.error_rate = 0.01
    bus = I2cBus(clock, 400e3, faults)
    volts = {0: 1.0, 3: -1.0}  # A0-A1 and A2-A3
    bus.attach(72, Ads1115Chip(clock, lambda mux, start, end: volts[mux], faults, seed=seed))
    i2c = LinuxI2c(bus.transfer, {1}, lambda seconds: setattr(bus, "timeout", seconds))
    with ExitStack() as stack:
        i2c.install()
        stack.callback(i2c.remove)
        driver = Ads1115(Ads1115Settings(frozen_after=None), clock)
        sensor = SampledSensor(driver, ForceCalibration(), clock, threaded=False, tick=0.004)
        stack.callback(sensor.close)
        pairs = failures = 0
        now = 0.0
        while 2 * pairs < reads:
            now = max(now + 0.004, clock.monotonic())
            try:
                measurement = sensor.read(now)
            except SensorError:
                failures += 1
                continue
            if measurement.samples and not (
                abs(measurement.fx - 1.0) < 0.01 and abs(measurement.fy + 1.0) < 0.01
            ):
                raise BrokenPromise(f"read {2 * pairs}: {measurement}")
            pairs += measurement.samples
        errors = sensor.counters()
    recovered = ", ".join(f"{count} {name}" for name, count in errors.items())
    return (
        f"channels, {2 * pairs} reads with 1 % failing transfers: no value of the wrong channel; "
        f"recovered from: {recovered}; {failures} windows without a pair"
    )


def virtual_pi_config(folder: str, seed: int) -> Config:
    """Return the configuration of the default virtual Pi, with its state in `folder`."""
    overrides = ["robot=virtual-pi", f"simulation.seed={seed}"]
    return load(None, [*overrides, f"state_folder={folder}"])


def verdict(what: str, publisher: Counting, memory: Memory) -> str:
    """Return the figures of a soak as a line; raises `BrokenPromise` when memory grew."""
    grown = memory.verdict(what)
    reasons = ", ".join(f"{count} {code}" for code, count in sorted(publisher.reasons.items()))
    return (
        f"{what}: no exception, every angle within limits, {grown}; "
        f"faults latched: {reasons or 'none'}"
    )


OPTIONS: Options = {
    "soak": {"choices": ("simulated", "virtual-pi", "channels", "all")},
    "--ticks": {"type": int, "help": f"default {SIMULATED_TICKS} and {VIRTUAL_PI_TICKS}"},
    "--reads": {"type": int, "default": 1_000_000, "help": "conversions; default 1000000"},
    "--seed": {"type": int, "default": 1},
}


def measure(options: Namespace) -> Report:
    """Run the requested soaks; raises `BrokenPromise`."""
    logging.disable(logging.CRITICAL)  # avoids reports of thousands of faults
    soaks: dict[str, Callable[[], str]] = {
        "simulated": lambda: soak_simulated(options.ticks or SIMULATED_TICKS, options.seed),
        "virtual-pi": lambda: soak_virtual_pi(options.ticks or VIRTUAL_PI_TICKS, options.seed),
        "channels": lambda: soak_channels(options.reads, options.seed),
    }
    lines = []
    for name in soaks if options.soak == "all" else (options.soak,):
        progress(f"soak: {name}")
        begun = time.perf_counter()
        lines.append(f"- {soaks[name]()} ({time.perf_counter() - begun:.0f} s)")
    number = "<br>".join(line.removeprefix("- ").partition(";")[0] for line in lines)
    return Report({"reliability soak": "\n".join(lines)}, lines, number=number)
