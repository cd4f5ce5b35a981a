"""Deaths of fishd on a virtual Pi, and measurement of the servo pulses after each.

The virtual Pi runs in this process and fishd in another one, as on a robot. Times are those of
changes of the servo pulses, from the moment of the failure. Ends by itself.
"""

import signal
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from threading import Barrier

from msgspec import Struct

from common.daemon import START, TIMEOUT_S, Fishd, virtual_pi
from common.report import Options, Report, progress, table
from fishd.client import Fish, NoDaemon
from fishd.virtual.pi.virtual_pi import VirtualPi
from reliability.kills import GPIO, NEUTRAL, Lane

WATCHED = 1.8
"""Time that the pulses are observed after the failure [s]."""

SABOTAGED_FISHD = """
import signal
from importlib import import_module
import fishd.daemon.main

def sabotage(*_):
    setattr(getattr(import_module({module!r}), {owner!r}), {method!r}, lambda *a, **k: 1 / 0)

signal.signal(signal.SIGUSR1, sabotage)
fishd.daemon.main.main()
"""

Deed = Callable[[VirtualPi, Fishd], None]


def signalled(number: signal.Signals) -> Deed:
    """Return a failure that sends fishd a signal."""
    return lambda pi, fishd: fishd.process.send_signal(number)


def stopped(seconds: float) -> Deed:
    """Return a failure that stops fishd for a while."""

    def deed(pi: VirtualPi, fishd: Fishd) -> None:
        fishd.process.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        fishd.process.send_signal(signal.SIGCONT)

    return deed


def injected(fault: str) -> Deed:
    """Return a failure that starts a fault of the virtual Pi."""
    return lambda pi, fishd: pi.faults.inject(fault)


def killed_with_pigpiod(pi: VirtualPi, fishd: Fishd) -> None:
    """Kill fishd, and pigpiod directly afterwards, which restarts."""
    fishd.process.kill()
    time.sleep(0.02)
    pi.faults.inject("pigpiod-restart")


# Failures, and their names in the table.
DEATHS: dict[str, tuple[str, Deed]] = {
    "SIGTERM": ("a request to end", signalled(signal.SIGTERM)),
    "SIGINT": ("Ctrl-C", signalled(signal.SIGINT)),
    "SIGKILL": ("kill -9, or out of memory", signalled(signal.SIGKILL)),
    "SIGKILL of both": ("fishd, then pigpiod, which is started again", killed_with_pigpiod),
    "SIGSEGV": ("a crash of the interpreter", signalled(signal.SIGSEGV)),
    "SIGSTOP": ("a hang of the whole process", signalled(signal.SIGSTOP)),
    "SIGCONT": ("a hang that ends after 1 s", stopped(1.0)),
    "unplugged": ("the force sensor loses its power", injected("unplugged")),
    "stuck-busy": ("the ADC hangs", injected("stuck-busy")),
    "timeout": ("the I2C bus hangs", injected("timeout")),
    "frozen-code": ("the ADC repeats itself", injected("frozen-code")),
    "pigpiod-gone": ("pigpiod ends", injected("pigpiod-gone")),
}
# Exceptions in each phase of a tick, and between ticks: module, class and method that raises.
PHASES = {
    "read": ("fishd.hardware.force_sensor.sampled_sensor", "SampledSensor", "read"),
    "estimate": ("fishd.control.estimators.lateral_force", "LateralForceEstimator", "update"),
    "update": ("fishd.controllers.waveform", "Square", "update"),
    "guard": ("fishd.control.guard", "Guard", "apply"),
    "write": ("fishd.hardware.servo.pigpio", "Pigpio", "write"),
    "publish": ("fishd.daemon.gateway.gateways", "Telemetry", "tick"),
    "statistics": ("fishd.control.statistics", "Statistics", "add"),
    "between ticks": ("fishd.daemon.requests", "Operations", "status"),
}
ENDS = {
    *("SIGTERM", "SIGINT", "SIGKILL", "SIGKILL of both", "SIGSEGV"),
    *("statistics", "between ticks"),
}
"""Failures after which fishd must end; after the others it continues, or hangs."""


class Outcome(Struct):
    """Servo pulses after a failure; times from the failure [s], None for never."""

    neutral: float | None
    """Time from which the pulses stayed at neutral until they ended."""
    off: float | None
    """Time of the end of the pulses."""
    status: int | None
    """Exit status of fishd, negative for a signal; None while it still runs."""
    reason: str | None
    """Reason of the fault in `status`, where fishd still answers."""


def swim_again(fishd: Fishd) -> None:
    """Clear a fault, and let the tail beat for a second."""
    with Fish(fishd.endpoint) as fish:
        fish.clear_fault()
        fish.set_controller("square")
    time.sleep(1.0)


def die(name: str, together: Barrier) -> Outcome:
    """Apply one of `DEATHS` or `PHASES` to a fishd once all of `together` swim; watch its servo."""
    command: Sequence[str] = START
    deed = DEATHS[name][1] if name in DEATHS else signalled(signal.SIGUSR1)
    if name in PHASES:
        module, owner, method = PHASES[name]
        source = SABOTAGED_FISHD.format(module=module, owner=owner, method=method)
        command = (sys.executable, "-c", source)
    with (
        tempfile.TemporaryDirectory(prefix="fishd-") as folder,
        virtual_pi(Path(folder)) as (pi, on_it),
        closing(Lane(pi, on_it, 0, command)) as lane,
    ):
        fishd = lane.swim()
        together.wait(3 * TIMEOUT_S)
        if not pi.pigpiod.width(GPIO, time.monotonic()):
            swim_again(fishd)  # the machine stalled meanwhile, and fishd is in fault
        begun = time.monotonic()
        deed(pi, fishd)
        time.sleep(WATCHED + (2.0 if name == "frozen-code" else 0.0))
        pi.pigpiod.width(GPIO, time.monotonic())
        changes = [(when - begun, width) for when, width in pi.pigpiod.history(GPIO)]
        if name in ENDS:
            with suppress(subprocess.TimeoutExpired):
                fishd.process.wait(TIMEOUT_S)  # a busy machine may need longer than that
        status = fishd.process.poll()
        reason = None if status is not None or name == "SIGSTOP" else fault(fishd)
    return Outcome(*ending(changes), status, reason)


def ending(changes: list[tuple[float, float]]) -> tuple[float | None, float | None]:
    """Return the times at which the pulses came to neutral and ended; None for never."""
    if not changes or changes[-1][1] != 0.0:
        return None, None
    off = changes[-1][0]
    before = changes[-2]
    return (max(0.0, before[0]) if abs(before[1] - NEUTRAL) <= 5.0 else None), off


def fault(fishd: Fishd) -> str | None:
    """Return the code of fishd's fault."""
    try:
        reason = fishd.status().reason
    except NoDaemon:
        return None
    return reason.code if reason else None


def row(name: str, outcome: Outcome) -> list[str]:
    """Return the row of a failure."""
    what = f"{name}: {DEATHS[name][0]}" if name in DEATHS else f"an exception in `{name}`"
    neutral = "–" if outcome.neutral is None else f"{outcome.neutral * 1e3:.0f}"
    off = "–" if outcome.off is None else f"{outcome.off * 1e3:.0f}"
    if outcome.status is not None:
        end = f"ends with {outcome.status}" if outcome.status >= 0 else "is dead"
    else:
        end = f"fault `{outcome.reason}`" if outcome.reason else "hangs"
    return [what, neutral, off, end]


OPTIONS: Options = {
    "--only": {
        "choices": [*DEATHS, *PHASES],
        "nargs": "+",
        "default": [],
        "help": "these deaths, side by side",
    },
}


def measure(options: Namespace) -> Report:
    """Run every failure; takes half a minute."""
    outcomes = {}
    for names in [options.only] if options.only else [[name] for name in (*DEATHS, *PHASES)]:
        with ThreadPoolExecutor(len(names)) as pool:
            results = list(pool.map(partial(die, together=Barrier(len(names))), names))
        outcomes |= dict(zip(names, results, strict=True))
        for name in names:
            progress(*row(name, outcomes[name]))
    head = "what happens | neutral after [ms] | no pulses after [ms] | fishd"
    rows = [row(*item) for item in outcomes.items()]
    return Report({"reliability deaths": table(head, rows)}, outcomes)
