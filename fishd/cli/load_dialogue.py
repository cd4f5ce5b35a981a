"""The dialogue of `fishctl calibrate force`: loads to hang and to measure, one after the other."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import click

from fishd.cli import load_files
from fishd.cli.load_files import NEWTONS
from fishd.cli.output import echo
from fishd.client import Fish
from fishd.errors import Refused
from fishd.hardware.calibration import ForceSample

PLAN = (
    ("zero", 0, 0, "nothing pulls at the fish"),
    ("+x", 1, 0, "pull the fish forward, as its own thrust does"),
    ("-x", -1, 0, "pull the fish backward"),
    ("+y", 0, 1, "pull the fish to its left"),
    ("-y", 0, -1, "pull the fish to its right"),
)
"""Name, direction and what to do, of the loads that suffice."""
RESTLESS = 3.0
"""So many times the quietest load's standard deviation is not still."""
_QUIET = 5e-5
"""No standard deviation below this is restless [V]."""


class _Measured(NamedTuple):
    """One load, how it is asked for, and what was measured under it."""

    name: str
    what: str
    ask: Callable[[], tuple[float, float]]
    load: tuple[float, float]
    """[N]"""
    sample: ForceSample


class Dialogue:
    """Guides through the loads and keeps what was measured."""

    def __init__(
        self, fish: Fish, unit: str, seconds: float, record: Path | None, limit: float
    ) -> None:
        """limit: no load is larger, along x or y [N]"""
        self._fish = fish
        self._unit = unit
        self._newtons = NEWTONS[unit]
        self._seconds = seconds
        self._record = record
        self._limit = limit
        self._measured: list[_Measured] = []
        self._usual = 0.0  # size of the latest load, in the unit

    def run(self, plan: list[tuple[float, float]]) -> None:
        """Measure a plan [N], or the usual one."""
        echo(f"The loads, each measured for {self._seconds:g} s:")
        if plan:
            names = [self._spelled(load) for load in plan]
            for n, name in enumerate(names, 1):
                echo(f"  {n}  {name}")
            for name, load in zip(names, plan, strict=True):
                self._add(name, "hang it", partial(_given, load))
        else:
            for n, (name, _, _, what) in enumerate(PLAN, 1):
                echo(f"  {n}  {name:<5} {what}")
            for name, x, y, what in PLAN:
                self._add(name, what, partial(self._ask_size, x, y))

    def amend(self) -> None:
        """Let the operator add loads, and measure or leave out those that are there."""
        while answer := _asked(
            f"\nAnother load, as F_x F_y in {self._unit}; NAME to measure that one again, "
            "drop NAME to leave it out; or Enter to fit"
        ):
            dropped = answer.removeprefix("drop ").strip()
            places = {each.name: place for place, each in enumerate(self._measured)}
            if answer in places:
                again = self._measured[places[answer]]
                self._measured[places[answer]] = self._measure(again.name, again.what, again.ask)
                self._write()
            elif dropped != answer and dropped in places:
                del self._measured[places[dropped]]
                self._write()
            elif extra := self._parsed(answer):
                if self._possible(*extra):
                    self._add(self._spelled(extra), "hang it", partial(_given, extra))
            else:
                names = ", ".join(places)
                echo(f"  two numbers, such as 10 -5, or one of {names} is needed", err=True)

    def result(self) -> tuple[list[str], list[tuple[float, ...]]]:
        """Names of the loads, and (F_x, F_y, V_x, V_y) of each."""
        self._warn_in_hindsight()
        names = [each.name for each in self._measured]
        return names, [(*each.load, each.sample.vx, each.sample.vy) for each in self._measured]

    def _add(self, name: str, what: str, ask: Callable[[], tuple[float, float]]) -> None:
        self._measured.append(self._measure(name, what, ask))
        self._write()

    def _measure(self, name: str, what: str, ask: Callable[[], tuple[float, float]]) -> _Measured:
        while True:
            echo(f"\n{name}: {what}, and let it come to rest")
            load = ask()
            _choice("  Enter when it is still")
            try:
                sample = self._fish.sample_force(self._seconds)
            except Refused as refusal:  # what was measured so far must not be lost
                echo(f"  not measured: {refusal}", err=True)
                continue
            echo(f"  {_spelled_sample(sample)}")
            if sample.suspect:
                echo(f"  warning: not to be believed: {sample.suspect}", err=True)
            if _restless(sample, [other.sample for other in self._measured]):
                echo("  warning: it was not still, compared with other loads", err=True)
            if _choice("  Enter to go on, r to measure it again", "r") != "r":
                return _Measured(name, what, ask, load, sample)

    def _write(self) -> None:
        if self._record:
            load_files.write(self._record, [(each.load, each.sample) for each in self._measured])

    def _ask_size(self, x: int, y: int) -> tuple[float, float]:
        if not (x or y):
            return 0.0, 0.0
        while True:
            size = _number(f"  load [{self._unit}]", self._usual or None)
            if self._possible(size * self._newtons, 0.0):
                self._usual = size
                return x * size * self._newtons, y * size * self._newtons

    def _possible(self, fx: float, fy: float) -> bool:
        """Is it a load [N] that the sensor will believe? If not, that is said."""
        if why := load_files.beyond(fx, fy, self._limit):
            hint = "; did you mean --unit g?" if self._unit == "N" else ""
            echo(f"  {why}{hint}", err=True)
        return not why

    def _parsed(self, answer: str) -> tuple[float, float] | None:
        """A load of the operator's own [N]; None where that is none."""
        try:
            fx, fy = (float(word) * self._newtons for word in answer.split())
        except ValueError:
            return None
        return (fx, fy) if math.isfinite(fx) and math.isfinite(fy) else None

    def _spelled(self, load: tuple[float, float]) -> str:
        fx, fy = (component / self._newtons for component in load)
        return f"({fx:g}, {fy:g}) {self._unit}"

    def _warn_in_hindsight(self) -> None:
        """The first loads had nothing to be compared with."""
        samples = [each.sample for each in self._measured]
        for name, *_, sample in self._measured:
            if sample.suspect or _restless(sample, samples):
                why = sample.suspect or "it was not still, compared with other loads"
                echo(f"warning: {name}: {why}", err=True)


def _restless(sample: ForceSample, others: list[ForceSample]) -> bool:
    """Does it vary more than the quietest of the others?"""
    for name in ("vx_std", "vy_std"):
        quietest = min((getattr(other, name) for other in others), default=math.inf)
        if getattr(sample, name) > RESTLESS * max(quietest, _QUIET):
            return True
    return False


def _spelled_sample(sample: ForceSample) -> str:
    return (
        f"V_x {sample.vx:+.5f} ± {sample.vx_std:.5f} V   "
        f"V_y {sample.vy:+.5f} ± {sample.vy_std:.5f} V   {sample.pairs} pairs"
    )


def _asked(prompt: str) -> str:
    """What is typed at a prompt; empty for Enter alone."""
    answer: str = click.prompt(prompt, default="", show_default=False)
    return answer.strip()


def _choice(prompt: str, *letters: str) -> str:
    """Ask until the answer is one of these letters, or empty for Enter alone."""
    while (answer := _asked(prompt).lower()) and answer not in letters:
        possible = " or ".join(("Enter", *letters))
        echo(f"  only {possible} is possible here; Ctrl-C ends it all", err=True)
    return answer


def _number(text: str, default: float | None) -> float:
    """Ask for a size until it is one."""
    while True:
        size: float = click.prompt(text, type=float, default=default)
        if math.isfinite(size) and size > 0.0:
            return size
        echo("  a positive number is needed; the direction is given", err=True)


def _given(load: tuple[float, float]) -> tuple[float, float]:
    return load
