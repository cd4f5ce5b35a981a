"""Attacks on the sockets of a fishd, and measurement of their cost: ticks, lateness, memory.

A second fishd without attacks runs beside it. Both share the machine with the attackers, so that
the difference is the cost of the attack itself. Everything stays on this machine, and ends.
"""

import math
import resource
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Callable
from contextlib import ExitStack, suppress

from msgspec import Struct

from common.daemon import Fishd
from common.machine import priorities
from common.report import Options, Report, progress, table
from fishd.client import Fish, FishError
from fishd.core.signals import Status
from reliability import attackers

DOCUMENT = "reference/reliability.md"
SECONDS = 10.0
SETTLE = 2.0
TICKS = 0.05, 0.005


class Seen(Struct, frozen=True):
    """Measurements of one fishd during one attack."""

    missed: int
    """Number of skipped slots."""
    ticks: int
    worst: float
    """Largest lateness of a tick since its start [ms]."""
    memory: float
    """Peak resident memory of the main process [MB]."""
    total: float
    """Peak memory including the gateways, with shared pages counted once (PSS) [MB]."""
    restarts: int
    """Number of restarts of gateways."""
    answer: float
    """Slowest answer to another client during the attack [ms]; infinite after a timeout."""
    estop: float
    """Duration of an emergency stop during the attack [ms]."""


class Outcome(Struct, frozen=True):
    """Results of an attack for the attacked fishd and for the one beside it."""

    attack: str
    tick: float
    attacked: Seen
    beside: Seen


class Watch:
    """Observer of a fishd during an attack."""

    def __init__(self, fishd: Fishd) -> None:
        self._fishd = fishd
        self._before: Status = fishd.status()
        self._memory = self._total = self._answer = self._estop = 0.0

    def look(self) -> None:
        """Measure the memory."""
        self._memory = max(self._memory, self._fishd.memory())
        self._total = max(self._total, self._fishd.total_memory())

    def ask(self) -> None:
        """Request the status as another client."""
        self._answer = max(self._answer, self._time(lambda fish: fish.status()))

    def stop(self) -> None:
        """Request an emergency stop as another client."""
        self._estop = self._time(lambda fish: fish.estop())

    def _time(self, request: Callable[[Fish], object]) -> float:
        begun = time.monotonic()
        with suppress(FishError), Fish(self._fishd.endpoint, timeout=2.0) as fish:
            request(fish)
            return time.monotonic() - begun
        return math.inf

    def result(self) -> Seen:
        """Return the measurements after the attack."""
        after = self._fishd.status()
        return Seen(
            missed=after.missed - self._before.missed,
            ticks=after.seq - self._before.seq,
            worst=after.timing.lateness.worst * 1e-3,
            memory=self._memory,
            total=self._total,
            restarts=after.counters["telemetry_restarts"] + after.counters["control_restarts"],
            answer=self._answer * 1e3,
            estop=self._estop * 1e3,
        )


def attack(name: str, tick: float, seconds: float) -> Outcome:
    """Run one attack, and return its outcome."""
    settings = (f"tick={tick}", f"realtime.priority={priorities()[-1]}")
    with ExitStack() as stack:
        fishes = [stack.enter_context(Fishd(*settings, tcp=True)) for _ in range(2)]
        for fishd in fishes:
            fishd.next_tick()
        time.sleep(SETTLE)
        watches = [Watch(fishd) for fishd in fishes]
        target = (fishes[0].telemetry, fishes[0].endpoint)
        attacker = subprocess.Popen(
            [sys.executable, attackers.__file__, name, *target, str(seconds)]
        )
        next_question, last = 0.0, time.monotonic() + 0.8 * seconds
        while attacker.poll() is None:
            for watch in watches:
                watch.look()
            if time.monotonic() > next_question:
                next_question = time.monotonic() + 0.5
                for watch in watches:
                    watch.ask()
            if time.monotonic() > last:
                last = float("inf")
                for watch in watches:
                    watch.stop()
            time.sleep(0.05)
        time.sleep(2.0)  # effects of the attack may come later
        for watch in watches:
            watch.look()
        return Outcome(name, tick, *(watch.result() for watch in watches))


def row(outcome: Outcome) -> list[str]:
    """Return the row of an attack."""
    a, b = outcome.attacked, outcome.beside
    what = (attackers.ATTACKS[outcome.attack].__doc__ or "").rstrip(".")
    return [
        f"`{outcome.attack}`: {what[0].lower()}{what[1:]}",
        f"{outcome.tick * 1e3:g}",
        f"{a.missed} / {b.missed} of {a.ticks}",
        f"{a.worst:.1f} / {b.worst:.1f}",
        f"{a.memory:.0f} / {a.total:.0f}",
        str(a.restarts),
        f"{a.answer:.0f} / {b.answer:.0f}",
        f"{a.estop:.0f} / {b.estop:.0f}",
    ]


OPTIONS: Options = {
    "--only": {"choices": list(attackers.ATTACKS), "help": "this attack"},
    "--tick": {"type": float, "help": "period of the loop [s]; two if left out"},
    "--seconds": {"type": float, "default": SECONDS, "help": "how long each attack lasts"},
}


def measure(options: Namespace) -> Report:
    """Run every attack at both ticks; takes some minutes."""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(8192, files[1]), files[1]))
    outcomes = []
    for name in [options.only] if options.only else attackers.ATTACKS:
        for tick in [options.tick] if options.tick else TICKS:
            outcomes.append(attack(name, tick, options.seconds))
            progress(*row(outcomes[-1]))
    head = (
        "attack | tick [ms] | ticks missed, attacked / beside | worst lateness [ms] | "
        "memory [MB], fishd (RSS) / with gateways (PSS) | gateways restarted | "
        "slowest answer to others [ms] | estop answered after [ms]"
    )
    return Report({"reliability attacks": table(head, map(row, outcomes))}, outcomes)
