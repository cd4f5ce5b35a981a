"""Kills of fishd at random times and in random situations, with a check that its pulses end.

Each lane has a virtual Pi and, one after another, real fishds on it. A kill is stuck when the servo
still gets pulses 1.5 s later. Ends by itself; exit status 1 when one was stuck.
"""

import itertools
import random
import signal
import tempfile
import threading
import time
from argparse import Namespace
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path

from msgspec import Struct

from common.daemon import START, Fishd, virtual_pi
from common.report import Options, Report, progress, table
from fishd.client import Fish
from fishd.core.errors import FishdError
from fishd.virtual.pi.virtual_pi import VirtualPi

GPIO, NEUTRAL = 18, 1500.0
"""Pin of the servo, and its pulse for a straight fin [µs]."""
WATCH_S = 1.5
"""Time after a kill from which there must be no pulses [s]."""
SWIM_TIMEOUT_S, ATTEMPTS = 15.0, 5
"""Time until a fishd must swim [s], and number of fishds that are tried on a busy machine."""
STOPPED = 0.15
"""Fraction of the kills that are a SIGSTOP instead: a process that hangs, and keeps its sockets."""


class Kill(Struct):
    """One kill, and the servo pulses after it."""

    situation: str
    stopped: bool
    """Whether SIGSTOP was sent instead of SIGKILL."""
    after: float
    """Time from the action to the kill [s]."""
    swimming: bool
    """Whether there were pulses at that moment."""
    off: float | None
    """Time from the kill to the end of the last pulse [s]; None: pulses continue."""
    width: float
    """Width of the continuing pulses [µs]; 0 without pulses."""


class Lane:
    """Virtual Pi, and the fishd that swims on it."""

    def __init__(
        self, pi: VirtualPi, settings: list[str], seed: int, command: Sequence[str] = START
    ) -> None:
        """settings, command: those of a fishd on this virtual Pi"""
        self.pi = pi
        self.random = random.Random(seed)
        self._settings, self._command = settings, command
        self.fishd: Fishd | None = None

    def start(self) -> Fishd:
        """Start a fishd."""
        timeout = self.random.choice((0.008, 0.02, 0.1))
        self.fishd = Fishd(
            *self._settings,
            "force_sensor.data_rate=128",  # a low load on a busy machine
            f"servo.timeout={timeout}",
            "start.controller=square",
            *("realtime.priority=0", "realtime.lock_memory=false"),
            command=self._command,
        )
        return self.fishd

    def close(self) -> None:
        """Kill fishd if it still runs, and wait for its end."""
        if self.fishd:
            self.fishd.kill()
            self.fishd.__exit__()
            self.fishd = None

    def swim(self) -> Fishd:
        """Start a fishd, and wait until its tail beats; retry where a busy machine disturbs it."""
        for _ in range(ATTEMPTS):
            fishd, beats = self.start(), self._beats()
            until = time.monotonic() + SWIM_TIMEOUT_S
            while time.monotonic() < until:
                if self._beats() >= beats + 3:
                    return fishd
                time.sleep(0.01)
            log = fishd.log.read_text(encoding="utf-8")[-2000:]
            self.close()
        raise SystemExit(f"fishd does not swim: {log}")

    def kill(self, name: str, stop: bool) -> Kill:
        """Bring a fishd into a situation, kill or stop it there, and observe its pulses."""
        situation = SITUATIONS[name]
        self.swim()
        time.sleep(self.random.uniform(0.0, 0.2))
        situation.cause(self)
        after = self.random.uniform(0.0, situation.window)
        time.sleep(after)
        assert self.fishd
        with suppress(ProcessLookupError):
            self.fishd.process.send_signal(signal.SIGSTOP if stop else signal.SIGKILL)
        killed = time.monotonic()
        swimming = self.pi.pigpiod.width(GPIO, killed) > 0.0
        time.sleep(WATCH_S)
        now = time.monotonic()
        width = self.pi.pigpiod.width(GPIO, now)
        times = [when for when, _ in self.pi.pigpiod.history(GPIO) if when <= now]
        self.close()
        if width:  # reset pigpiod for the next fishd
            self.pi.faults.inject("pigpiod-restart")
        off = None if width else max(0.0, times[-1] - killed)
        return Kill(name, stop, after, swimming, off, width)

    def _beats(self) -> int:
        history = self.pi.pigpiod.history(GPIO)
        return sum(abs(width - NEUTRAL) > 100.0 for _, width in history if width)


def inject(fault: str, seconds: float | None = None) -> Callable[[Lane], None]:
    """Return an action that starts a fault of the virtual Pi."""
    return lambda lane: lane.pi.faults.inject(fault, seconds)


def request(send: Callable[[Fish], object]) -> Callable[[Lane], None]:
    """Return an action that sends a request without waiting for the answer."""

    def cause(lane: Lane) -> None:
        assert lane.fishd
        endpoint = lane.fishd.endpoint

        def call() -> None:
            with suppress(FishdError), Fish(endpoint, timeout=5.0) as fish:
                send(fish)

        threading.Thread(target=call, daemon=True).start()

    return cause


def restart_fishd(lane: Lane) -> None:
    """Kill the running fishd, and start the next one at once."""
    lane.close()
    lane.start()


def terminate_fishd(lane: Lane) -> None:
    """Send SIGTERM."""
    assert lane.fishd
    lane.fishd.process.terminate()


def clear_fault(fish: Fish) -> None:
    """Send an emergency stop, and clear it after it has acted."""
    fish.estop()
    time.sleep(0.1)
    fish.clear_fault()


class Situation(Struct):
    """Situation of fishd when it is killed."""

    what: str
    """Description for the table."""
    share: int
    """Number per hundred kills."""
    window: float
    """Length of the interval after the action in which the kill occurs at random [s]."""
    cause: Callable[[Lane], None]


SITUATIONS = {
    "swims": Situation("it swims", 10, 0.2, lambda lane: None),
    "starts": Situation("it starts after one that was killed", 16, 1.2, restart_fishd),
    "frozen": Situation("pigpiod hangs for 30 ms", 22, 0.12, inject("pigpiod-frozen", 0.03)),
    "frozen long": Situation(
        "pigpiod hangs for 0.3 s, and it connects again", 10, 0.5, inject("pigpiod-frozen", 0.3)
    ),
    "gone": Situation(
        "pigpiod is gone for 50 ms, and it connects again", 6, 0.5, inject("pigpiod-gone", 0.05)
    ),
    "restart": Situation("pigpiod is started again", 6, 0.4, inject("pigpiod-restart")),
    "stops": Situation("it stops (SIGTERM)", 10, 0.8, terminate_fishd),
    "loads": Situation(
        *("it loads a policy", 6, 0.6),
        request(lambda fish: fish.set_controller("ppo", policy="default-fish")),
    ),
    "estop": Situation("an emergency stop", 10, 0.02, request(lambda fish: fish.estop())),
    "clears": Situation(
        "a fault is cleared, and it gets pulses again", 4, 0.3, request(clear_fault)
    ),
}


def plan(kills: int, seed: int, only: str | None) -> list[tuple[str, bool]]:
    """Return kills in random order: situation, and whether to send SIGSTOP."""
    hundred = [name for name, situation in SITUATIONS.items() for _ in range(situation.share)]
    chance = random.Random(seed)
    names = list(itertools.islice(itertools.cycle(chance.sample(hundred, len(hundred))), kills))
    chance.shuffle(names)
    stops = random.Random(f"stops {seed}")
    return [(only or name, stops.random() < STOPPED) for name in names]


def run_lane(kills: list[tuple[str, bool]], seed: int, deadline: float) -> list[Kill]:
    """Perform these kills one after another; those after the deadline are left out."""
    results = []
    with (
        tempfile.TemporaryDirectory(prefix="fishd-") as folder,
        virtual_pi(Path(folder)) as (pi, settings),
        closing(Lane(pi, settings, seed)) as lane,
    ):
        for name, stop in kills:
            if time.monotonic() > deadline:
                break
            results.append(lane.kill(name, stop))
            if results[-1].off is None:
                progress(f"stuck: {results[-1]}")
    return results


def summary(kills: list[Kill], seed: int) -> str:
    """Return the sections for the document."""
    rows = []
    for name, situation in SITUATIONS.items():
        own = [kill for kill in kills if kill.situation == name]
        times = [kill.off for kill in own if kill.off is not None]
        if own:
            late = f"{max(times) * 1e3:.0f}" if times else "–"
            counts = (len(own), sum(kill.swimming for kill in own), late, len(own) - len(times))
            rows.append([situation.what, *map(str, counts)])
    stuck, stopped = sum(kill.off is None for kill in kills), sum(kill.stopped for kill in kills)
    rows.append(["all", str(len(kills)), str(sum(kill.swimming for kill in kills)), "", str(stuck)])
    head = "fishd is killed while | kills | with pulses on | pulses off after, at most [ms] | stuck"
    return f"{table(head, rows)}\n\nSeed {seed}; {stopped} of them by SIGSTOP."


OPTIONS: Options = {
    "--kills": {"type": int, "default": 200, "help": "number of kills; default: 200"},
    "--lanes": {"type": int, "default": 4, "help": "number of virtual Pis; default: 4"},
    "--seed": {"type": int, "default": 1, "help": "seed of the random number generator"},
    "--only": {"choices": [*SITUATIONS], "help": "this situation"},
    "--limit": {"type": float, "default": 3600.0, "help": "longest time [s]"},
}


def measure(options: Namespace) -> Report:
    """Run the kills."""
    planned = plan(options.kills, options.seed, options.only)
    deadline = time.monotonic() + options.limit
    lanes = [(planned[k :: options.lanes], 1000 * options.seed + k) for k in range(options.lanes)]
    with ThreadPoolExecutor(options.lanes) as pool:
        results = [pool.submit(run_lane, *lane, deadline) for lane in lanes]
        kills = [kill for result in results for kill in result.result()]
    stuck = sum(kill.off is None for kill in kills)
    longest = max(1e3 * (kill.off or 0.0) for kill in kills)
    number = f"{stuck} of {len(kills)} stuck; pulses off after at most {longest:.0f} ms"
    text = summary(kills, options.seed)
    return Report({"reliability kills": text}, kills, broken=stuck > 0, number=number)
