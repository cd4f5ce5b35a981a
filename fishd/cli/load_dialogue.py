"""The dialogue of `fishctl calibrate force`: loads to hang and to measure, one after the other."""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path

import click

from fishd.cli import load_files
from fishd.cli.load_files import NEWTONS
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


class Dialogue:
    """Guides through the loads and keeps what was measured."""

    def __init__(self, fish: Fish, unit: str, seconds: float, record: Path | None) -> None:
        self._fish = fish
        self._unit = unit
        self._newtons = NEWTONS[unit]
        self._seconds = seconds
        self._record = record
        self._names: list[str] = []
        self._measured: list[tuple[tuple[float, float], ForceSample]] = []
        self._usual = 0.0  # size of the latest load, in the unit

    def run(self, plan: list[tuple[float, float]]) -> None:
        """Measure a plan [N], or the usual one, and whatever the operator adds."""
        click.echo(f"The loads, each measured for {self._seconds:g} s:")
        if plan:
            names = [self._spelled(load) for load in plan]
            for n, name in enumerate(names, 1):
                click.echo(f"  {n}  {name}")
            for name, load in zip(names, plan, strict=True):
                self._measure(name, "hang it", partial(_given, load))
        else:
            for n, (name, _, _, what) in enumerate(PLAN, 1):
                click.echo(f"  {n}  {name:<5} {what}")
            for name, x, y, what in PLAN:
                self._measure(name, what, partial(self._ask_size, x, y))
        while self.extend():
            pass

    def extend(self) -> bool:
        """Measure another load, of the operator's choice; False where there is to be none."""
        extra = self._ask_extra()
        if extra is None:
            return False
        self._measure(self._spelled(extra), "hang it", partial(_given, extra))
        return True

    def result(self) -> tuple[list[str], list[tuple[float, ...]]]:
        """Names of the loads, and (F_x, F_y, V_x, V_y) of each."""
        self._warn_in_hindsight()
        measured = self._measured
        return self._names, [(fx, fy, sample.vx, sample.vy) for (fx, fy), sample in measured]

    def _measure(self, name: str, what: str, ask: Callable[[], tuple[float, float]]) -> None:
        while True:
            click.echo(f"\n{name}: {what}, and let it come to rest")
            load = ask()
            click.prompt("  Enter when it is still", default="", show_default=False)
            try:
                sample = self._fish.sample_force(self._seconds)
            except Refused as refusal:  # what was measured so far must not be lost
                click.echo(f"  not measured: {refusal}", err=True)
                continue
            click.echo(f"  {_spelled_sample(sample)}")
            if sample.suspect:
                click.echo(f"  warning: not to be believed: {sample.suspect}", err=True)
            others = [other for _, other in self._measured]
            if _restless(sample, others):
                click.echo("  warning: it was not still, compared with other loads", err=True)
            answer = click.prompt(
                "  Enter to go on, r to measure it again", default="", show_default=False
            )
            if answer.strip().lower() not in ("r", "redo", "again"):
                break
        self._names.append(name)
        self._measured.append((load, sample))
        if self._record:
            load_files.write(self._record, self._measured)

    def _ask_size(self, x: int, y: int) -> tuple[float, float]:
        if not (x or y):
            return 0.0, 0.0
        size = _number(f"  load [{self._unit}]", self._usual or None)
        self._usual = size
        return x * size * self._newtons, y * size * self._newtons

    def _ask_extra(self) -> tuple[float, float] | None:
        """Another load of the operator's own [N]; None when there are enough."""
        while True:
            answer = click.prompt(
                f"\nAnother load, as F_x F_y in {self._unit}, or Enter to fit",
                default="",
                show_default=False,
            )
            if not answer.strip():
                return None
            try:
                fx, fy = (float(word) * self._newtons for word in answer.split())
            except ValueError:
                fx = fy = math.nan
            if math.isfinite(fx) and math.isfinite(fy):
                return fx, fy
            click.echo("  two numbers are needed, such as: 10 -5", err=True)

    def _spelled(self, load: tuple[float, float]) -> str:
        fx, fy = (component / self._newtons for component in load)
        return f"({fx:g}, {fy:g}) {self._unit}"

    def _warn_in_hindsight(self) -> None:
        """The first loads had nothing to be compared with."""
        samples = [sample for _, sample in self._measured]
        for name, sample in zip(self._names, samples, strict=True):
            if sample.suspect or _restless(sample, samples):
                why = sample.suspect or "it was not still, compared with other loads"
                click.echo(f"warning: {name}: {why}", err=True)


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


def _number(text: str, default: float | None) -> float:
    """Ask for a size until it is one."""
    while True:
        size: float = click.prompt(text, type=float, default=default)
        if math.isfinite(size) and size > 0.0:
            return size
        click.echo("  a positive number is needed; the direction is given", err=True)


def _given(load: tuple[float, float]) -> tuple[float, float]:
    return load
