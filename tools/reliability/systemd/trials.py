"""Trials on the booted system, and their required results.

Each trial returns a row of the report; raises `BrokenPromise` where a promise of fishd is not kept.
"""

import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from common.report import BrokenPromise
from reliability.systemd.container import Container, Entry, wait_for

NEUTRAL = 1500.0
"""Pulse of a straight fin in the trial's configuration [us]."""
NEUTRAL_LIMIT = 0.3
"""Longest time from the daemon's sudden death to a neutral servo [s]."""
CONFIG = "etc/fishd/fishd.yaml"
STATUS = ("fishctl", "status", "--timing")
"""Command that shows whether the loop has real-time scheduling."""
RESTART = ("sh", "-c", "fishctl restart 2>&1")
"""Command that asks fishd for a restart, and shows why it is refused."""
REALTIME = "real-time scheduling"
"""Words of its output where the loop has it."""
FAULT = " fault: "
"""Part of the line that fishd logs at a fault."""
WRONG_LINE = "tik: 0.05\n"
"""Line that makes a configuration wrong."""
SUGGESTION = "did you mean 'tick'?"
"""Part of what fishd says about it."""
FAILED = "fishd has failed"
"""Part of what the failure unit says."""
_UNIT = "fishd.service"


class Row(NamedTuple):
    """Result of one trial; times count from the action on the daemon [s]."""

    what: str
    neutral: float | None
    off: float | None
    again: float | None
    """Time until the restarted daemon was ready."""
    outcome: str


class Rig:
    """Container with fishd and its virtual Pi, and the pulses at the servo."""

    def __init__(self, container: Container, pulses: Path) -> None:
        """pulses: file that watch_pulses.py writes"""
        self.container = container
        self._pulses = pulses

    def systemctl(self, *words: str, check: bool = True) -> str:
        """Run systemctl inside."""
        return self.container.run("systemctl", *words, check=check)

    def swim(self) -> None:
        """Restart fishd, and make it swim."""
        self.systemctl("stop", _UNIT, check=False)
        self.systemctl("reset-failed", _UNIT, "fishd-failure.service", check=False)
        begun = time.monotonic()
        self.systemctl("start", _UNIT)
        time.sleep(1.5)
        faults = [e.message for e in self.container.journal(begun) if FAULT in e.message]
        if faults or self.pulse() in (0.0, NEUTRAL):
            raise BrokenPromise(f"the fish does not swim: {', '.join(faults) or 'no pulses'}")

    def pulse(self) -> float:
        """Return the current pulse [us]; 0: none."""
        return self.pulses()[-1][1]

    def pulses(self) -> list[tuple[float, float]]:
        """Return time [s] and pulse [us] at each change."""
        lines = self._pulses.read_text().splitlines(keepends=True)
        return [(float(t), float(p)) for t, p in (x.split() for x in lines if x.endswith("\n"))]

    def signal(self, name: str) -> float:
        """Send a signal to the daemon, and return its time [s]."""
        now = time.monotonic()
        self.systemctl("kill", "--kill-whom=main", f"--signal={name}", _UNIT)
        return now

    def when(self, since: float, words: str, unit: str = _UNIT) -> float:
        """Wait for a line with these words in the journal; return its time after `since` [s]."""

        def matching_entries() -> list[Entry]:
            entries = self.container.journal(since)
            return [e for e in entries if words in e.message and e.unit == unit]

        wait_for(lambda: bool(matching_entries()), f"the journal does not say '{words}'")
        return matching_entries()[0].time - since

    def time_pulses(self, since: float) -> tuple[float, float]:
        """Return the times from `since` until the servo stayed neutral and its pulses ended."""
        wait_for(lambda: any(t > since and p == 0 for t, p in self.pulses()), "pulses go on")
        changes = [(t, p) for t, p in self.pulses() if t > since]
        last = next(i for i, (_, pulse) in enumerate(changes) if pulse == 0)
        if last == 0 or changes[last - 1][1] != NEUTRAL:
            raise BrokenPromise("the pulses ended before the servo was neutral")
        return changes[last - 1][0] - since, changes[last][0] - since


def start(rig: Rig) -> Row:
    """Start the unit until READY=1, which the first tick sends."""
    rig.systemctl("stop", _UNIT)
    begun = time.monotonic()
    rig.systemctl("start", _UNIT)
    ready = rig.when(begun, "Started fishd.service")
    rig.swim()
    check_scheduling(rig.container.run(*STATUS))
    return Row("`systemctl start`", None, None, ready, "ready with the first tick")


def check_scheduling(status: str) -> None:
    """Raise `BrokenPromise` where the output of `STATUS` shows no real-time scheduling."""
    if REALTIME not in status:
        raise BrokenPromise("the daemon has no real-time scheduling")


def stop(rig: Rig) -> Row:
    """Stop the unit by SIGTERM: fade, release, end."""
    begun = time.monotonic()
    rig.systemctl("stop", _UNIT)
    ended = rig.when(begun, "Stopped fishd.service")
    if rig.container.show(_UNIT, "Result") != "success":
        raise BrokenPromise("a clean stop counts as a failure")
    return Row("`systemctl stop`", *rig.time_pulses(begun), None, f"stopped after {ended:.2f} s")


def restarted(rig: Rig) -> Row:
    """Ask fishd for a restart: refused while it swims, else systemd starts it again."""
    config = rig.container.root / CONFIG
    good = config.read_text()
    refused = rig.container.run(*RESTART, check=False)
    rig.container.run("fishctl", "stop")
    config.write_text(good + WRONG_LINE)
    try:
        refused += rig.container.run(*RESTART, check=False)
    finally:
        config.write_text(good)
    if "[running]" not in refused or "[bad-configuration]" not in refused:
        raise BrokenPromise(f"a restart is not refused: {refused}")
    begun = time.monotonic()
    rig.container.run("fishctl", "restart")
    again = rig.when(begun, "Started fishd.service")
    pulses = rig.time_pulses(begun)
    if rig.container.show(_UNIT, "Result") != "success":
        raise BrokenPromise("a restart counts as a failure")
    return Row("`fishctl restart`", *pulses, again, "refused while it swims, else restarted")


def killed(rig: Rig) -> Row:
    """Kill fishd by SIGKILL: the script in pigpiod acts, then ExecStopPost, then a restart."""
    return _check_restart(rig, "kill −9", rig.signal("SIGKILL"), "Main process exited", "ended")


def hung(rig: Rig) -> Row:
    """Stop the process, so that nothing feeds the watchdog."""
    return _check_restart(
        rig, "hang (SIGSTOP)", rig.signal("SIGSTOP"), "Watchdog timeout", "watchdog"
    )


def _check_restart(rig: Rig, what: str, begun: float, sign: str, name: str) -> Row:
    noticed = rig.when(begun, sign)
    neutral, off = rig.time_pulses(begun)
    again = rig.when(begun, "Started fishd.service")
    if neutral > NEUTRAL_LIMIT:
        raise BrokenPromise(
            f"{what}: neutral after {neutral:.3f} s; {NEUTRAL_LIMIT} s are promised"
        )
    return Row(what, neutral, off, again, f"{name} after {noticed:.2f} s, released, restarted")


def killed_again_and_again(rig: Rig) -> Row:
    """Kill fishd until systemd gives up, which the failure unit reports."""
    begun = time.monotonic()
    while (state := rig.container.show(_UNIT, "ActiveState")) != "failed":
        if time.monotonic() > begun + 120:
            raise BrokenPromise("a daemon that always dies is restarted for ever")
        if state == "active":
            rig.signal("SIGKILL")
        time.sleep(0.1)
    said = rig.when(begun, FAILED, "fishd-failure.service")
    starts = [e for e in rig.container.journal(begun) if e.message.startswith("Started fishd.")]
    if said < starts[-1].time - begun:
        raise BrokenPromise("the failure unit has acted before fishd was given up")
    if rig.pulse() != 0:
        raise BrokenPromise("pulses go on after the service was given up")
    outcome = (
        f"given up after {len(starts)} restarts, {said:.0f} s; failure unit has run, pulses off"
    )
    return Row("kill −9, again and again", None, None, None, outcome)


def wrong_config(rig: Rig) -> Row:
    """Start with a wrong configuration: exit status 78, once, which the failure unit reports."""
    config = rig.container.root / CONFIG
    good = config.read_text()
    rig.systemctl("stop", _UNIT)
    begun = time.monotonic()
    config.write_text(good + WRONG_LINE)
    try:
        rig.systemctl("start", _UNIT, check=False)
        rig.when(begun, FAILED, "fishd-failure.service")
        time.sleep(4.0)  # several times RestartSec
        status = rig.container.show(_UNIT, "ExecMainStatus")
        restarts = rig.container.show(_UNIT, "NRestarts")
    finally:
        config.write_text(good)
    if (status, restarts) != ("78", "0"):
        raise BrokenPromise(f"a wrong configuration: exit status {status}, {restarts} restarts")
    rig.when(begun, SUGGESTION)
    return Row("wrong configuration", None, None, None, "exit 78, no restart; failure unit has run")


TRIALS: tuple[Callable[[Rig], Row], ...] = (
    start,
    stop,
    restarted,
    killed,
    hung,
    killed_again_and_again,
    wrong_config,
)
