"""Kills and stops of fishd and of its gateways, and measurement of the recovery.

For each failure, measure the time until an emergency stop is answered, for a client that connects
afterwards and for one that was connected before, and the time until the sockets are served again.
Then kill the control gateway eight times in a row, each time as soon as it answers; and run
`fishctl estop` where fishd itself hangs or is dead, on a virtual Pi. Ends by itself; exit status 1
where a promise was not kept.
"""

import os
import signal
import tempfile
import time
from argparse import Namespace
from contextlib import ExitStack, suppress
from pathlib import Path
from statistics import median

import zmq
from msgspec import Struct

from common.daemon import TIMEOUT_S, Fishd, virtual_pi
from common.processes import FISHCTL, call
from common.report import Options, Report, progress, table
from fishd.client import Fish, NoDaemon
from fishd.virtual.pi.virtual_pi import VirtualPi

DOCUMENT = "reference/reliability.md"
MAX_ESTOP_S = 0.2
"""Longest time to the answer to an emergency stop after a single failure [s]."""
MAX_CONTROL_S = 0.5
"""Longest time until the control socket is served again after its gateway failed [s]."""
MAX_TELEMETRY_S = 1.0
"""Longest time until the telemetry socket is served again after its gateway failed [s]."""
KILLS_IN_A_ROW = 8
SETTLE_S = 0.5
"""Time for fishd to swim again before the next failure [s]."""
GPIO = 18

FAILURES = {
    "SIGKILL of the control gateway": (("control",), signal.SIGKILL),
    "SIGSTOP of the control gateway": (("control",), signal.SIGSTOP),
    "SIGKILL of the telemetry gateway": (("telemetry",), signal.SIGKILL),
    "SIGSTOP of the telemetry gateway": (("telemetry",), signal.SIGSTOP),
    "SIGKILL of their fork server": (("gateways",), signal.SIGKILL),
    "SIGSTOP of their fork server": (("gateways",), signal.SIGSTOP),
    "SIGSTOP of all three": (("gateways", "control", "telemetry"), signal.SIGSTOP),
}
SINGLE = [name for name in FAILURES if name != "SIGSTOP of all three"]


class Trials(Struct):
    """Measured times of one failure [s]."""

    new_client: list[float] = []
    """Times to the answer to an emergency stop, for clients that connected after the failure."""
    old_client: list[float] = []
    """Times to the answer to an emergency stop, for clients that were connected before."""
    control: list[float] = []
    """Times until a request was answered through the control socket."""
    telemetry: list[float] = []
    """Times until a subscriber that connected after the failure got a tick."""


def fail(fishd: Fishd, name: str) -> float:
    """Cause the failure, and return its time [s]."""
    kinds, number = FAILURES[name]
    pids = [fishd.gateway(kind) for kind in kinds]
    for pid in pids:
        os.kill(pid, number)
    return time.monotonic()


def time_answer(fishd: Fishd, begun: float) -> float:
    """Return the time until `status` is answered to one of a series of new clients [s]."""
    while time.monotonic() < begun + TIMEOUT_S:
        with suppress(NoDaemon), Fish(fishd.endpoint, timeout=0.25) as fish:
            fish.status(0.25)
            return time.monotonic() - begun
    raise SystemExit(f"no answer within {TIMEOUT_S} s: {fishd.log.read_text(encoding='utf-8')}")


def time_tick(fishd: Fishd, begun: float) -> float:
    """Return the time until a subscriber that connects now gets a tick [s]."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    socket = context.socket(zmq.SUB)
    socket.set(zmq.RECONNECT_IVL, 2)
    socket.subscribe(b"tick")
    socket.connect(fishd.telemetry)
    if not socket.poll(int(TIMEOUT_S * 1e3)):
        raise SystemExit(f"no tick: {fishd.log.read_text(encoding='utf-8')}")
    took = time.monotonic() - begun
    context.destroy(linger=0)
    return took


def swim_again(fishd: Fishd) -> None:
    """Clear the emergency stop, and swim for a while."""
    with Fish(fishd.endpoint) as fish:
        fish.clear_fault()
        fish.set_controller("swing")
    time.sleep(SETTLE_S)


def try_failure(fishd: Fishd, name: str, times: int) -> Trials:
    """Measure one failure `times` times, each quantity as often."""
    trials = Trials()
    for _ in range(times):
        with Fish(fishd.endpoint) as connected:
            connected.status()
            begun = fail(fishd, name)
            connected.estop(name)
            trials.old_client.append(time.monotonic() - begun)
            trials.control.append(time_answer(fishd, begun))
        time_tick(fishd, begun)
        swim_again(fishd)
        begun = fail(fishd, name)
        with Fish(fishd.endpoint) as fish:
            fish.estop(name)
            trials.new_client.append(time.monotonic() - begun)
        trials.telemetry.append(time_tick(fishd, begun))
        time_answer(fishd, begun)
        swim_again(fishd)
    return trials


def kill_in_a_row(fishd: Fishd) -> list[float]:
    """Kill the control gateway repeatedly; return the times to the answer to `status` [s]."""
    times = []
    for _ in range(KILLS_IN_A_ROW):
        os.kill(fishd.gateway("control"), signal.SIGKILL)
        times.append(time_answer(fishd, time.monotonic()))
    return times


class LastResort(Struct):
    """Trials of `fishctl estop` on a fishd that does not answer."""

    off: list[float] = []
    """Times from its start to the end of the pulses."""
    failed: int = 0
    """Number of trials with an exit status other than 0, or with remaining pulses."""


def try_last_resort(number: signal.Signals, times: int) -> LastResort:
    """Stop or kill a fishd on a virtual Pi with a long countdown, and run `fishctl estop`."""
    trials = LastResort()
    settings = ("servo.timeout=0.05", "servo.countdown=2", "force_sensor.data_rate=128")
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fishd-")))
        pi, on_it = stack.enter_context(virtual_pi(folder))
        for _ in range(times):
            with Fishd(*on_it, *settings, "start.controller=square") as fishd:
                await_pulses(pi)
                time.sleep(SETTLE_S)
                fishd.process.send_signal(number)
                begun = time.monotonic()
                ended = call(FISHCTL, "--endpoint", fishd.endpoint, "estop")
                time.sleep(0.1)
                width = pi.pigpiod.width(GPIO, time.monotonic())
                trials.failed += bool(ended.returncode or width)
                when, _ = pi.pigpiod.history(GPIO)[-1]
                trials.off.append(when - begun)
                fishd.process.kill()
    return trials


def await_pulses(pi: VirtualPi) -> None:
    """Wait until the servo gets pulses."""
    deadline = time.monotonic() + TIMEOUT_S
    while not pi.pigpiod.width(GPIO, time.monotonic()):
        if time.monotonic() > deadline:
            raise SystemExit("fishd does not swim")
        time.sleep(0.01)


def spread(values: list[float]) -> str:
    """Format median and largest [ms]."""
    return f"{median(values) * 1e3:.0f} / {max(values) * 1e3:.0f}"


OPTIONS: Options = {
    "--times": {"type": int, "default": 20, "help": "of each; default 20"},
    "--only": {"choices": [*FAILURES], "nargs": "+", "default": [*FAILURES]},
}


def measure(options: Namespace) -> Report:
    """Run all failures; takes about ten minutes."""
    trials: dict[str, Trials] = {}
    with Fishd() as fishd:
        fishd.next_tick()
        time_answer(fishd, time.monotonic())
        for name in options.only:
            trials[name] = try_failure(fishd, name, options.times)
            progress(name, *_row(name, trials[name])[2:])
        rows_of_kills = []
        for _ in range(options.times):
            rows_of_kills.append(kill_in_a_row(fishd))
            time.sleep(2.0)
        progress("kills in a row", spread([max(row) for row in rows_of_kills]))
        missed = fishd.status().missed
    resorts = {number.name: try_last_resort(number, options.times) for number in RESORTS}
    head = (
        "what fails | times | emergency stop answered to a new client after, median / worst [ms] | "
        "to a client that was connected [ms] | requests answered again after [ms] | "
        "telemetry again after [ms]"
    )
    by_kill = " | ".join(
        f"{number}: {spread([row[number - 1] for row in rows_of_kills])}"
        for number in range(1, KILLS_IN_A_ROW + 1)
    )
    words = {"SIGSTOP": "SIGSTOP of fishd", "SIGKILL": "SIGKILL of fishd"}
    resort_rows = [
        [words[name], str(len(resort.off)), str(resort.failed), spread(resort.off)]
        for name, resort in resorts.items()
    ]
    text = "\n\n".join(
        (
            table(head, [_row(name, trial) for name, trial in trials.items()]),
            f"{KILLS_IN_A_ROW} kills of the control gateway in a row, {options.times} times; "
            f"`status` answered after the n-th kill, median / worst [ms]: {by_kill}. "
            f"Ticks missed in all of that: {missed}.",
            table(
                "`fishctl estop` after | times | failed | pulses off after its start, "
                "median / worst [ms]",
                resort_rows,
            ),
        )
    )
    broken = any(
        max(trial.new_client + trial.old_client) > MAX_ESTOP_S
        or ("control" in name and max(trial.control) > MAX_CONTROL_S)
        or ("telemetry" in name and max(trial.telemetry) > MAX_TELEMETRY_S)
        for name, trial in trials.items()
        if name in SINGLE
    ) or any(resort.failed for resort in resorts.values())
    figures = {"failures": trials, "kills in a row": rows_of_kills, "last resort": resorts}
    return Report({"reliability gateways": text}, figures, broken=broken)


RESORTS = (signal.SIGSTOP, signal.SIGKILL)


def _row(name: str, trials: Trials) -> list[str]:
    measured = (trials.new_client, trials.old_client, trials.control, trials.telemetry)
    return [name, str(len(trials.control)), *map(spread, measured)]
