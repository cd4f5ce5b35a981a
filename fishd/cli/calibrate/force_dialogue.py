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
"""Name, direction and instruction of each load; five suffice, the others test the fit."""
MIN_RESTLESS_RATIO = 3.0
"""Smallest ratio of the standard deviations of a moving load and of the quietest load."""
_QUIET_STD_V = 5e-5
"""Lower limit of the quietest standard deviation in this comparison [V]."""
_NOT_STILL = "it was not still, compared with other loads"

Force = tuple[float, float]
"""F_x and F_y of a load [N]."""


class _Measured(NamedTuple):
    """One load, the prompt for it, and its measurement."""

    name: str
    what: str
    ask: Callable[[], Force]
    load: Force
    sample: ForceSample


class Dialogue:
    """Dialogue that asks for the loads and keeps the measurements."""

    def __init__(
        self, fish: Fish, unit: str, seconds: float, record: Path | None, limit: float
    ) -> None:
        """limit: largest load along x or y [N]"""
        self._fish = fish
        self._unit = unit
        self._newtons = NEWTONS[unit]
        self._seconds = seconds
        self._record = record
        self._limit = limit
        self._measured: dict[str, _Measured] = {}
        self._latest_size: float | None = None
        """Size of the latest load [`unit`]."""

    def run(self, plan: list[Force]) -> None:
        """Measure the loads of a plan, or of the default plan if it is empty."""
        prompts = [self._describe_load(load) for load in plan] or [
            (name, what, partial(self._ask_size, x, y)) for name, x, y, what in PLAN
        ]
        echo(f"The loads, each measured for {self._seconds:g} s:")
        for n, (name, what, _) in enumerate(prompts, 1):
            echo(f"  {n}  {name:<8} {what}")
        for prompt in prompts:
            self._add(*prompt)

    def amend(self) -> None:
        """Let the operator add loads, and measure again or drop measured ones."""
        while answer := click.prompt(
            f"\nAnother load, as F_x F_y in {self._unit}; NAME to measure that one again, "
            "drop NAME to leave it out; or Enter to fit",
            default="",
            show_default=False,
        ).strip():
            dropped = answer.removeprefix("drop ").strip()
            if answer in self._measured:
                repeated = self._measured[answer]
                self._measure(repeated.name, repeated.what, repeated.ask)
            elif dropped != answer and dropped in self._measured:
                del self._measured[dropped]
                self._write()
            elif extra := self._parse_load(answer):
                if self._is_within_limit(extra):
                    self._add(*self._describe_load(extra))
            else:
                names = ", ".join(self._measured)
                echo(f"  two numbers, such as 10 -5, or one of {names} is needed", err=True)

    def result(self) -> tuple[list[str], list[Load]]:
        """Return the names of the loads and the loads; warn of those that were not still."""
        samples = [item.sample for item in self._measured.values()]
        for name, item in self._measured.items():
            if item.sample.suspect or _is_restless(item.sample, samples):
                echo(f"warning: {name}: {item.sample.suspect or _NOT_STILL}", err=True)
        loads = [
            Load(*item.load, item.sample.vx, item.sample.vy) for item in self._measured.values()
        ]
        return list(self._measured), loads

    def _add(self, name: str, what: str, ask: Callable[[], Force]) -> None:
        while name in self._measured:
            name += " again"
        self._measure(name, what, ask)

    def _measure(self, name: str, what: str, ask: Callable[[], Force]) -> None:
        """Measure until the operator accepts; until then the previous measurement is kept."""
        others = [measured.sample for measured in self._measured.values()]
        answer = "r"
        while answer == "r":
            echo(f"\n{name}: {what}, and let it come to rest")
            load = ask()
            choose("  Enter when it is still", "")
            try:
                sample = self._fish.sample_force(self._seconds)
            except FishError as error:  # the earlier loads must not be lost
                echo(f"  not measured: {error}", err=True)
                continue
            echo(
                f"  V_x {sample.vx:+.5f} ± {sample.vx_std:.5f} V   "
                f"V_y {sample.vy:+.5f} ± {sample.vy_std:.5f} V   {sample.pairs} pairs"
            )
            if sample.suspect:
                echo(f"  warning: suspect: {sample.suspect}", err=True)
            if _is_restless(sample, others):
                echo(f"  warning: {_NOT_STILL}", err=True)
            answer = choose("  Enter to go on, r to measure it again", "", "r")
        self._measured[name] = _Measured(name, what, ask, load, sample)
        self._write()

    def _write(self) -> None:
        if self._record:
            measured = [(item.load, item.sample) for item in self._measured.values()]
            try:
                load_files.write(self._record, measured)
            except OSError as error:  # the next load tries again
                echo(f"  warning: {self._record}: cannot be written: {error.strerror}", err=True)

    def _ask_size(self, x: int, y: int) -> Force:
        size = 0.0
        while x or y:
            positive = FiniteRange(min=0.0, min_open=True)
            size = click.prompt(f"  load [{self._unit}]", type=positive, default=self._latest_size)
            if self._is_within_limit((size * self._newtons, 0.0)):
                self._latest_size = size
                break
        return x * size * self._newtons, y * size * self._newtons

    def _is_within_limit(self, load: Force) -> bool:
        """Return whether a load [N] is within the limit of the sensor; print a message if not."""
        if problem := load_files.explain_excess(*load, self._limit):
            hint = "; did you mean --unit g?" if self._unit == "N" else ""
            echo(f"  {problem}{hint}", err=True)
        return not problem

    def _parse_load(self, answer: str) -> Force | None:
        """Return a load [N] that the operator types; None if it is not two numbers."""
        try:
            fx, fy = (float(word) * self._newtons for word in answer.split())
        except ValueError:
            return None
        return (fx, fy) if math.isfinite(fx + fy) else None

    def _describe_load(self, load: Force) -> tuple[str, str, Callable[[], Force]]:
        """Return name, instruction and prompt of a load that the operator names."""
        fx, fy = (component / self._newtons for component in load)
        return f"({fx:g}, {fy:g}) {self._unit}", "hang it", lambda: load


def _is_restless(sample: ForceSample, others: list[ForceSample]) -> bool:
    """Return whether a sample varies much more than the quietest of the others."""
    for name in ("vx_std", "vy_std"):
        quietest = min((getattr(other, name) for other in others), default=math.inf)
        if getattr(sample, name) > MIN_RESTLESS_RATIO * max(quietest, _QUIET_STD_V):
            return True
    return False
