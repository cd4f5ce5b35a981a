"""Lets fishd die in every way on a virtual Pi, and measures what its servo gets.

    python tools/reliability.py                          a table on standard output
    python tools/reliability.py --death kill-9 --json    one of them, for programs
    python tools/reliability.py --write docs/reliability.md

The virtual Pi runs in this process and fishd in its own, as on a robot. Times are those at which
the servo pulses changed, from the moment of the deed. Ends by itself.
"""

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
from msgspec import Struct
from reports import put, table

from fishd.client import Fish, NoDaemon
from fishd.clock import SystemClock
from fishd.emulation.link_server import LinkServer
from fishd.emulation.settings import VirtualPiSettings
from fishd.emulation.virtual_pi import VirtualPi
from fishd.hardware.imperfections import SimulationSettings
from fishd.plant.parameters import PlantParameters

GPIO = 18
NEUTRAL = 1500.0
PATIENCE = 20.0
WATCHED = 1.8
"""How long the pulses are watched after the deed [s]."""
FISHD = str(Path(sys.executable).with_name("fishd"))

SABOTAGED_FISHD = """
import signal
from importlib import import_module
import fishd.daemon

def sabotage(*_):
    setattr(getattr(import_module({module!r}), {owner!r}), {method!r}, lambda *a, **k: 1 / 0)

signal.signal(signal.SIGUSR1, sabotage)
fishd.daemon.main()
"""

Deed = Callable[[VirtualPi, "subprocess.Popen[bytes]"], None]


def signalled(number: signal.Signals) -> Deed:
    """Send fishd a signal."""
    return lambda pi, process: process.send_signal(number)


def stopped(seconds: float) -> Deed:
    """Stop fishd for a while."""

    def deed(pi: VirtualPi, process: "subprocess.Popen[bytes]") -> None:
        process.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        process.send_signal(signal.SIGCONT)

    return deed


def injected(fault: str) -> Deed:
    """Let a fault of the virtual Pi begin."""
    return lambda pi, process: pi.faults.inject(fault)


def killed_with_pigpiod(pi: VirtualPi, process: "subprocess.Popen[bytes]") -> None:
    """Kill fishd, and pigpiod right after; it is started again."""
    process.kill()
    time.sleep(0.02)
    pi.faults.inject("pigpiod-restart")


# What is done, how it is called in the table.
DEATHS: dict[str, tuple[str, Deed]] = {
    "SIGTERM": ("asked to stop", signalled(signal.SIGTERM)),
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
# An exception in each phase of a tick, and between ticks: module, class and method that raises.
PHASES = {
    "read": ("fishd.hardware.ads1115", "Ads1115Sensor", "read"),
    "estimate": ("fishd.estimators.lateral_force", "LateralForceEstimator", "update"),
    "update": ("fishd.controllers.waveform", "Square", "update"),
    "guard": ("fishd.guard", "Guard", "apply"),
    "write": ("fishd.hardware.pigpio", "PigpioServo", "write"),
    "publish": ("fishd.telemetry", "Telemetry", "tick"),
    "statistics": ("fishd.statistics", "Statistics", "add"),
    "between ticks": ("fishd.operations", "Operations", "status"),
}


class Outcome(Struct):
    """What the servo got after the deed; times in seconds from then, None for never."""

    neutral: float | None
    """When the pulses came to neutral to stay there until they ended."""
    off: float | None
    """When they ended."""
    status: int | None
    """Exit status of fishd, negative for a signal; None while it still runs."""
    reason: str | None
    """Reason of the fault, from `status`, where fishd still answers."""


@contextmanager
def swimming(
    folder: Path, command: list[str]
) -> "Iterator[tuple[VirtualPi, subprocess.Popen[bytes], str]]":
    """A fishd that swims on a virtual Pi in this process; both are gone afterwards."""
    settings = VirtualPiSettings(pigpio_port=0)
    pi = VirtualPi(settings, PlantParameters(), SimulationSettings(), 0.05, SystemClock())
    with LinkServer(pi, folder / "virtual-pi"):
        endpoint = f"ipc://{folder}/control"
        pairs = {
            "robot": "virtual-pi",
            "virtual_pi.socket": folder / "virtual-pi",
            "servo.pigpio.port": pi.pigpiod.port,
            "servo.pigpio.timeout": 0.05,  # a stall of the machine is not what is measured here
            "state_folder": folder / "state",
            "control.address": endpoint,
            "telemetry.address": f"ipc://{folder}/telemetry",
            "start.controller": "square",
        }
        options = [word for key, value in pairs.items() for word in ("--set", f"{key}={value}")]
        log = (folder / "log").open("wb")
        process = subprocess.Popen([*command, *options], stdout=log, stderr=log)
        try:
            await_pulses(pi, process, folder)
            yield pi, process, endpoint
        finally:
            process.send_signal(signal.SIGCONT)
            process.terminate()
            process.wait(PATIENCE)
            log.close()


def await_pulses(pi: VirtualPi, process: "subprocess.Popen[bytes]", folder: Path) -> None:
    """Until the tail has beaten from side to side a few times."""
    deadline = time.monotonic() + PATIENCE
    while len(pi.pigpiod.history(GPIO)) < 6:
        if time.monotonic() > deadline or process.poll() is not None:
            raise SystemExit(f"fishd does not swim: {(folder / 'log').read_text()}")
        time.sleep(0.01)


def die(name: str) -> Outcome:
    """Do one of DEATHS or PHASES to a swimming fishd, and watch its servo."""
    command = [FISHD]
    deed = DEATHS[name][1] if name in DEATHS else signalled(signal.SIGUSR1)
    if name in PHASES:
        module, owner, method = PHASES[name]
        source = SABOTAGED_FISHD.format(module=module, owner=owner, method=method)
        command = [sys.executable, "-c", source]
    with (
        tempfile.TemporaryDirectory(prefix="fishd-") as folder,
        swimming(Path(folder), command) as (pi, process, endpoint),
    ):
        begun = time.monotonic()
        deed(pi, process)
        time.sleep(WATCHED + (2.0 if name == "frozen-code" else 0.0))
        pi.pigpiod.width(GPIO, time.monotonic())
        changes = [(when - begun, width) for when, width in pi.pigpiod.history(GPIO)]
        status = process.poll()
        reason = None if status is not None or name == "SIGSTOP" else fault(endpoint)
    return Outcome(*ending(changes), status, reason)


def ending(changes: list[tuple[float, float]]) -> tuple[float | None, float | None]:
    """When the pulses came to neutral, and when they ended, if they did."""
    if not changes or changes[-1][1] != 0.0:
        return None, None
    off = changes[-1][0]
    before = changes[-2]
    return (max(0.0, before[0]) if abs(before[1] - NEUTRAL) <= 5.0 else None), off


def fault(endpoint: str) -> str | None:
    """The code of the reason that fishd gives."""
    try:
        with Fish(endpoint) as fish:
            reason = fish.status().reason
    except NoDaemon:
        return None
    return reason.code if reason else None


def row(name: str, outcome: Outcome) -> list[str]:
    """A line of the table."""
    what = f"{name}: {DEATHS[name][0]}" if name in DEATHS else f"an exception in `{name}`"
    neutral = "–" if outcome.neutral is None else f"{outcome.neutral * 1e3:.0f}"
    off = "–" if outcome.off is None else f"{outcome.off * 1e3:.0f}"
    if outcome.status is not None:
        end = f"ends with {outcome.status}" if outcome.status >= 0 else "is dead"
    else:
        end = f"fault `{outcome.reason}`" if outcome.reason else "hangs"
    return [what, neutral, off, end]


def main() -> int:
    """Measure, and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--death", choices=[*DEATHS, *PHASES], help="only this one")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--write", type=Path, help="put the table into this file")
    options = parser.parse_args()
    outcomes = {}
    for name in [options.death] if options.death else [*DEATHS, *PHASES]:
        outcomes[name] = die(name)
        if not options.json:
            print(" | ".join(row(name, outcomes[name])), flush=True)
    if options.json:
        print(msgspec.json.encode(outcomes).decode())
    if options.write:
        head = ["what happens", "neutral after [ms]", "no pulses after [ms]", "fishd"]
        put(options.write, "reliability", table(head, [row(*item) for item in outcomes.items()]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
