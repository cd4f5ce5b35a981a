"""The dialogue of `fishctl calibrate force`: loads to hang and to measure, one after the other."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import click

from fishd.cli.calibrate import load_files
from fishd.cli.calibrate.load_files import NEWTONS
from fishd.cli.options import FiniteRange
from fishd.cli.output import echo
from fishd.cli.prompts import choose
from fishd.client import Fish
from fishd.core.calibration import ForceSample
from fishd.core.errors import FishError
from fishd.hardware.force_sensor.calibration_fit import Load

_AXES = (
    ("+x", 1, 0, "pull the fish forward, as its own thrust does"),
    ("-x", -1, 0, "pull the fish backward"),
    ("+y", 0, 1, "pull the fish to its left"),
    ("-y", 0, -1, "pull the fish to its right"),
)
PLAN = (
    ("zero", 0, 0, "nothing pulls at the fish"),
    *_AXES,
    *(
        (f"{name} again", x, y, "hang it again, best with another weight")
        for name, x, y, _ in _AXES
    ),
)
"""Name, direction and what to do, of each load; five suffice, the others show how well they fit."""
RESTLESS = 3.0
"""So many times the quietest load's standard deviation is not still."""
_QUIET = 5e-5
"""No standard deviation below this is restless [V]."""
_SHOOK = "it was not still, compared with other loads"

Force = tuple[float, float]
"""F_x and F_y of a load [N]."""


class _Measured(NamedTuple):
    """One load, how it is asked for, and what was measured under it."""

    name: str
    what: str
    ask: Callable[[], Force]
    load: Force
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
        self._measured: dict[str, _Measured] = {}
        self._usual: float | None = None
        """Size of the latest load, in the unit."""

    def run(self, plan: list[Force]) -> None:
        """Measure a plan, or the usual one."""
        asks = [self._given(load) for load in plan] or [
            (name, what, partial(self._ask_size, x, y)) for name, x, y, what in PLAN
        ]
        echo(f"The loads, each measured for {self._seconds:g} s:")
        for n, (name, what, _) in enumerate(asks, 1):
            echo(f"  {n}  {name:<8} {what}")
        for each in asks:
            self._add(*each)

    def amend(self) -> None:
        """Let the operator add loads, and measure or leave out those that are there."""
        while answer := click.prompt(
            f"\nAnother load, as F_x F_y in {self._unit}; NAME to measure that one again, "
            "drop NAME to leave it out; or Enter to fit",
            default="",
            show_default=False,
        ).strip():
            dropped = answer.removeprefix("drop ").strip()
            if answer in self._measured:
                again = self._measured[answer]
                self._measure(again.name, again.what, again.ask)
            elif dropped != answer and dropped in self._measured:
                del self._measured[dropped]
                self._write()
            elif extra := self._parsed(answer):
                if self._possible(extra):
                    self._add(*self._given(extra))
            else:
                names = ", ".join(self._measured)
                echo(f"  two numbers, such as 10 -5, or one of {names} is needed", err=True)

    def result(self) -> tuple[list[str], list[Load]]:
        """The loads and their names; says which are doubtful, now that all can be compared."""
        samples = [each.sample for each in self._measured.values()]
        for name, each in self._measured.items():
            if each.sample.suspect or _restless(each.sample, samples):
                echo(f"warning: {name}: {each.sample.suspect or _SHOOK}", err=True)
        loads = [
            Load(*each.load, each.sample.vx, each.sample.vy) for each in self._measured.values()
        ]
        return list(self._measured), loads

    def _add(self, name: str, what: str, ask: Callable[[], Force]) -> None:
        while name in self._measured:
            name += " again"
        self._measure(name, what, ask)

    def _measure(self, name: str, what: str, ask: Callable[[], Force]) -> None:
        """Measure until the operator is content; what was measured before is kept till then."""
        others = [each.sample for each in self._measured.values()]
        answer = "r"
        while answer == "r":
            echo(f"\n{name}: {what}, and let it come to rest")
            load = ask()
            choose("  Enter when it is still", "")
            try:
                sample = self._fish.sample_force(self._seconds)
            except FishError as error:  # what was measured so far must not be lost
                echo(f"  not measured: {error}", err=True)
                continue
            echo(
                f"  V_x {sample.vx:+.5f} ± {sample.vx_std:.5f} V   "
                f"V_y {sample.vy:+.5f} ± {sample.vy_std:.5f} V   {sample.pairs} pairs"
            )
            if sample.suspect:
                echo(f"  warning: not to be believed: {sample.suspect}", err=True)
            if _restless(sample, others):
                echo(f"  warning: {_SHOOK}", err=True)
            answer = choose("  Enter to go on, r to measure it again", "", "r")
        self._measured[name] = _Measured(name, what, ask, load, sample)
        self._write()

    def _write(self) -> None:
        if self._record:
            measured = [(each.load, each.sample) for each in self._measured.values()]
            try:
                load_files.write(self._record, measured)
            except OSError as error:  # the next load tries again
                echo(f"  warning: {self._record}: cannot be written: {error.strerror}", err=True)

    def _ask_size(self, x: int, y: int) -> Force:
        size = 0.0
        while x or y:
            positive = FiniteRange(min=0.0, min_open=True)
            size = click.prompt(f"  load [{self._unit}]", type=positive, default=self._usual)
            if self._possible((size * self._newtons, 0.0)):
                self._usual = size
                break
        return x * size * self._newtons, y * size * self._newtons

    def _possible(self, load: Force) -> bool:
        """Is it a load that the sensor will believe? If not, that is said."""
        if why := load_files.beyond(*load, self._limit):
            hint = "; did you mean --unit g?" if self._unit == "N" else ""
            echo(f"  {why}{hint}", err=True)
        return not why

    def _parsed(self, answer: str) -> Force | None:
        """A load of the operator's own; None where that is none."""
        try:
            fx, fy = (float(word) * self._newtons for word in answer.split())
        except ValueError:
            return None
        return (fx, fy) if math.isfinite(fx + fy) else None

    def _given(self, load: Force) -> tuple[str, str, Callable[[], Force]]:
        """What it takes to measure a load of the operator's own."""
        fx, fy = (component / self._newtons for component in load)
        return f"({fx:g}, {fy:g}) {self._unit}", "hang it", lambda: load


def _restless(sample: ForceSample, others: list[ForceSample]) -> bool:
    """Does it vary more than the quietest of the others?"""
    for name in ("vx_std", "vy_std"):
        quietest = min((getattr(other, name) for other in others), default=math.inf)
        if getattr(sample, name) > RESTLESS * max(quietest, _QUIET):
            return True
    return False
