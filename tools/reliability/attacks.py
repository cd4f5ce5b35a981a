"""Attacks the sockets of a fishd, and measures what it costs: ticks, lateness, memory.

    python tools/attacks.py                                  a table on standard output
    python tools/attacks.py --attack flood --tick 0.005      one of them
    python tools/attacks.py --write docs/reliability.md

A second fishd swims beside it that nobody attacks. Both share the machine with the attackers, so
what the attack as such costs is the difference. Everything stays on this machine, and ends.
"""

import argparse
import os
import resource
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import msgspec
from attackers import ATTACKS
from bench_contestants import Fishd
from bench_machine import fifo_permitted
from msgspec import Struct
from reports import put, table

from fishd.client import Fish, FishError
from fishd.signals import Status

SECONDS = 10.0
SETTLE = 2.0
ATTACKERS = str(Path(__file__).with_name("attackers.py"))
TICKS = 0.05, 0.005


class Seen(Struct, frozen=True):
    """One fishd over one attack."""

    missed: int
    """Slots skipped."""
    ticks: int
    worst: float
    """Latest tick since its start [ms]."""
    memory: float
    """Most resident memory of fishd's own process [MB]."""
    total: float
    """Most of it with its gateways, pages that they share counted once (PSS) [MB]."""
    restarts: int
    """How often a gateway was started again."""
    answer: float
    """Slowest answer to another client during the attack [ms]; infinite where one was given up."""
    estop: float
    """How long an emergency stop took in the midst of it [ms]."""


class Outcome(Struct, frozen=True):
    """An attack, and what it did to the fishd that was attacked and to the one beside it."""

    attack: str
    tick: float
    attacked: Seen
    beside: Seen


class Watch:
    """Looks at a fishd while it is attacked."""

    def __init__(self, fishd: Fishd) -> None:
        self._fishd = fishd
        self._before: Status = fishd.status()
        self._memory = self._total = self._answer = self._estop = 0.0

    def look(self) -> None:
        """Take its memory, and ask it something."""
        pids = [self._fishd.pid, *self._fishd.gateways()]
        self._memory = max(self._memory, size(pids[0], "Rss"))
        self._total = max(self._total, sum(size(pid, "Pss") for pid in pids))

    def ask(self) -> None:
        """Ask for its status, as another client."""
        begun = time.monotonic()
        try:
            with Fish(self._fishd.endpoint, timeout=2.0) as fish:
                fish.status()
            self._answer = max(self._answer, time.monotonic() - begun)
        except FishError:
            self._answer = float("inf")

    def stop(self) -> None:
        """Ask for an emergency stop, as another client."""
        begun = time.monotonic()
        try:
            with Fish(self._fishd.endpoint, timeout=2.0) as fish:
                fish.estop()
            self._estop = time.monotonic() - begun
        except FishError:
            self._estop = float("inf")

    def result(self) -> Seen:
        """Once the attack is over."""
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


def size(pid: int, kind: str) -> float:
    """Memory of a process, Rss or Pss [MB]; 0 once it has ended."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0.0
    return next((int(s.split()[1]) / 1024 for s in lines if s.startswith(f"{kind}:")), 0.0)


def attack(name: str, tick: float, seconds: float) -> Outcome:
    """Let one attack happen."""
    priority = 50 if fifo_permitted() else 0
    settings = (f"tick={tick}", f"realtime.priority={priority}")
    with ExitStack() as stack:
        fishes = [stack.enter_context(Fishd(*settings)) for _ in range(2)]
        for fishd in fishes:
            fishd.next_tick()
        time.sleep(SETTLE)
        watches = [Watch(fishd) for fishd in fishes]
        target = fishes[0].status().telemetry
        attacker = subprocess.Popen(
            [sys.executable, ATTACKERS, name, target, fishes[0].endpoint, str(seconds)]
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
        time.sleep(2.0)  # what it led to may come later
        for watch in watches:
            watch.look()
        return Outcome(name, tick, *(watch.result() for watch in watches))


def row(outcome: Outcome) -> list[str]:
    """A line of the table."""
    a, b = outcome.attacked, outcome.beside
    what = (ATTACKS[outcome.attack].__doc__ or "").rstrip(".")
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


def main() -> int:
    """Attack, and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--attack", choices=list(ATTACKS), help="only this one")
    parser.add_argument("--tick", type=float, help="period of the loop [s]; two if left out")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="how long each attack lasts")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--write", type=Path, help="put the table into this file")
    options = parser.parse_args()
    files = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(8192, files[1]), files[1]))
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    outcomes = []
    for name in [options.attack] if options.attack else ATTACKS:
        for tick in [options.tick] if options.tick else TICKS:
            outcomes.append(attack(name, tick, options.seconds))
            if not options.json:
                print(" | ".join(row(outcomes[-1])), flush=True)
    if options.json:
        print(msgspec.json.encode(outcomes).decode())
    if options.write:
        head = [
            "attack",
            "tick [ms]",
            "ticks missed, attacked / beside",
            "worst lateness [ms]",
            "memory [MB], fishd (RSS) / with gateways (PSS)",
            "gateways restarted",
            "slowest answer to others [ms]",
            "estop answered after [ms]",
        ]
        put(options.write, "attacks", table(head, [row(outcome) for outcome in outcomes]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
