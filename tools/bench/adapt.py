"""Quality of the choice and of the claim of `fishctl adapt`, on fish that differ from the model.

The harsh fish are like those of `tools/bench swims swing`, with other seeds and with all effects of
a real rig, in random sizes. Foreign fish have a servo of another law. `adapt` runs on each in
virtual time, by default for five minutes of tank time. The truth is the mean thrust of the
simulated fish, which `adapt` does not use.
"""

import math
import random
import statistics
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

from msgspec import Struct
from msgspec.structs import replace

from common.foreign_fish import best_wave, foreign_fish
from common.report import JOBS, Options, Report, percent, progress, run_cases, table
from fishd.config import Config, Start, load
from fishd.core.signals import Event, Tick
from fishd.lab.compare.comparison import Standing
from fishd.lab.compare.survey import harsh
from fishd.lab.experiment import Header, open_experiment
from fishd.lab.session import VirtualSession
from fishd.learning.adapt.adaptation import adapt, add_true_thrusts
from fishd.learning.adapt.results import SQUARE, Adapted, Verdict
from fishd.virtual.plant.optimum import best_square_wave

FIRST_SEED = 900
"""First seed of the harsh fish; other seeds were used during development."""
MAX_INTERVAL = 4000
"""Largest number of ticks and steps of training before an interruption."""
EQUAL = 0.9999
"""Ratio of thrusts from which two gaits count as equal."""


class Result(Struct, frozen=True):
    """Result for one fish."""

    seed: int
    best: float
    """Thrust of the best square wave [N]."""
    verdict: Verdict
    gaits: dict[str, Standing]
    """Measured thrusts, by gait."""
    true_thrusts: dict[str, float]
    """True thrusts, by gait [N]."""
    tank_time: float
    """Duration of the adaptation [s]."""

    def truth(self, gait: str) -> float:
        """Return the true thrust of a gait [N]."""
        return self.true_thrusts[gait]

    def errors(self) -> list[float]:
        """Return the error of the measured thrust of each gait [N]."""
        return [gait.thrust - self.truth(name) for name, gait in self.gaits.items()]

    @property
    def largest(self) -> float:
        """Largest true thrust of the gaits [N]."""
        return max(self.true_thrusts.values())

    @property
    def includes_best(self) -> bool:
        """Whether the gaits that may be the best include the truly best one."""
        return max(map(self.truth, self.verdict.undecided_gaits)) > EQUAL * self.largest

    def covers(self, gait: str) -> bool:
        """Return whether the interval of a gait's relative thrust contains the true one."""
        _, low, high = self.verdict.relative_thrusts[gait]
        return low <= self.truth(gait) / self.truth(SQUARE) <= high


class _Interruption(BaseException):
    """An end of the process, which no part of an adaptation may catch."""


class _Display:
    """Progress display without output, which may interrupt the adaptation."""

    def __init__(self, end: int | None) -> None:
        """end: number of ticks and of steps of training after which to interrupt"""
        self._left = math.inf if end is None else end

    def done(self, line: str, amount: float) -> None:
        """Ignore the end of a step."""

    def at(self, amount: float, outcome: str | None = None) -> None:
        """Count a step of the training; raise `_Interruption` at the end."""
        self._left -= 1
        if self._left <= 0:
            raise _Interruption

    def tick(self, _: Tick) -> None:
        """Count a tick."""
        self.at(0.0)

    def event(self, _: Event) -> None:
        """Ignore an event."""

    def warn(self, line: str) -> None:
        """Ignore a warning."""


def _adapt(config: Config, path: Path, steps: int, tank_time: float, ends: list[int]) -> Adapted:
    """Adapt to a fish, interrupted after each of these numbers of ticks, and resumed."""
    header = Header(kind="adapt", on="simulation")
    for attempt, end in enumerate([*ends, None]):
        try:
            with open_experiment(path, header, resume=attempt > 0) as experiment:
                display = _Display(end)
                with VirtualSession(config) as session, session.heard_by(display):
                    result = adapt(session, experiment, tank_time, steps, 0, display)
                return add_true_thrusts(result, config)
        except _Interruption:
            continue
    raise AssertionError("the last attempt is not interrupted")


def adapted(task: tuple[str, int, int, float, int]) -> Result:
    """Adapt to one fish.

    task: kind, seed, steps of the training, tank time [s], number of interruptions
    """
    kind, seed, steps, tank_time, interruptions = task
    chance = random.Random(seed)
    ends = [chance.randrange(1, MAX_INTERVAL) for _ in range(interruptions)]
    if kind == "foreign":
        config = foreign_fish(seed)
        best = best_wave(config)
    else:
        config = replace(load(None, harsh(seed).overrides), start=Start())
        best = best_square_wave(config.plant, config.amplitude_limit).thrust
    with TemporaryDirectory() as folder:
        found = _adapt(config, Path(folder) / "adapt", steps, tank_time, ends)
    progress(f"fish {seed}", found.verdict.claim)
    gaits = {gait.contestant: gait for gait in found.gaits}
    return Result(seed, best, found.verdict, gaits, found.true_thrusts, found.tank_time)


def row(result: Result) -> list[str]:
    """Return the row of the table for one fish."""
    verdict = result.verdict
    chosen = verdict.chosen_gait
    bold = (f"**{gait}**" if gait == chosen else gait for gait in verdict.undecided_gaits)
    claim = ["100, the same gait", "100"]
    if chosen in verdict.relative_thrusts:
        value, low, high = map(percent, verdict.relative_thrusts[chosen])
        truth = percent(result.truth(chosen) / result.truth(SQUARE))
        claim = [f"{value} [{low}, {high}]", truth]
    return [
        str(result.seed),
        f"{1e3 * result.best:.2f}",
        f"{chosen} wins" if verdict.is_decided else ", ".join(bold),
        *(percent(result.truth(gait) / result.best) for gait in (chosen, SQUARE)),
        *claim,
        f"{result.tank_time:.0f}",
    ]


def summary(results: list[Result]) -> str:
    """Return medians, worst values and coverage."""
    chosen = [result.truth(result.verdict.chosen_gait) for result in results]
    shares = [thrust / result.best for thrust, result in zip(chosen, results, strict=True)]
    lost = [1.0 - thrust / result.largest for thrust, result in zip(chosen, results, strict=True)]
    decided = [result for result in results if result.verdict.is_decided]
    policies = [r.truth("policy") / r.best for r in results if "policy" in r.gaits]
    claims = [
        result
        for result in results
        if result.verdict.chosen_gait in result.verdict.relative_thrusts
    ]
    gaits = [(result, gait) for result in results for gait in result.verdict.relative_thrusts]
    thrusts = [gait for result in results for gait in result.gaits.values()]
    off = [abs(error) for result in results for error in result.errors()]
    total = [gait.known_ci95 or 0.0 for gait in thrusts]
    rows = [
        ["chosen gait, % of the best square wave", *_middle_and_worst(shares, min)],
        ["policy, % of the best square wave", *_middle_and_worst(policies, min)],
        ["policies that took part", _count(["policy" in r.gaits for r in results])],
        ["verdicts that name a winner", _count([r.verdict.is_decided for r in results])],
        ["winners that are truly the best", _count([r.includes_best for r in decided])],
        ["verdicts that include the best gait", _count([r.includes_best for r in results])],
        ["loss of the chosen gait against the truly best", *_middle_and_worst(lost, max)],
        [
            "interval of the chosen gait's relative thrust contains the true value",
            _count([result.covers(result.verdict.chosen_gait) for result in claims]),
        ],
        [
            "the same, all gaits except the square wave",
            _count([result.covers(gait) for result, gait in gaits]),
        ],
        [
            "statistical interval of a thrust contains the true value",
            _count([a <= (gait.thrust_ci95 or 0.0) for a, gait in zip(off, thrusts, strict=True)]),
        ],
        [
            "total interval of a thrust contains the true value",
            _count([a <= b for a, b in zip(off, total, strict=True)]),
        ],
        ["longest tank time", f"{max(result.tank_time for result in results):.0f} s"],
    ]
    return table("quantity | measured | worst", [[*cells, ""][:3] for cells in rows])


def _count(values: list[bool]) -> str:
    return f"{sum(values)} of {len(values)}"


def _middle_and_worst(shares: list[float], worst: Callable[[list[float]], float]) -> list[str]:
    if not shares:
        return ["–", "–"]
    return [f"{percent(statistics.median(shares))} %", f"{percent(worst(shares))} %"]


OPTIONS: Options = {
    **JOBS,
    "--kind": {"choices": ("harsh", "foreign"), "default": "harsh", "help": "kind of the fish"},
    "--first": {"type": int, "default": FIRST_SEED, "help": "seed of the first fish"},
    "--fish": {"type": int, "default": 10, "help": "number of fish"},
    "--steps": {"type": int, "default": 6400, "help": "steps of each training"},
    "--budget": {"type": float, "default": 300.0, "help": "tank time of each fish [s]"},
    "--interruptions": {
        "type": int,
        "default": 0,
        "help": "number of interruptions of each adaptation at random ticks; it is resumed",
    },
}


def measure(options: Namespace) -> Report:
    """Return two tables; takes half a minute per fish."""
    seeds = range(options.first, options.first + options.fish)
    shared = options.steps, options.budget, options.interruptions
    tasks = [(options.kind, seed, *shared) for seed in seeds]
    results = run_cases(adapted, tasks, options.jobs)
    head = (
        "fish | best square wave, mN | verdict | true thrust of the chosen gait, % of the best | "
        "of the square wave found, % of the best | chosen gait ÷ square wave found, measured, % | "
        "the same, true, % | tank time, s"
    )
    name = "bench adapt" if options.kind == "harsh" else "bench adapt foreign"
    sections = {name: table(head, map(row, results)), f"{name} summary": summary(results)}
    errors = [
        error / (gait.known_ci95 or math.inf)
        for result in results
        for gait, error in zip(result.gaits.values(), result.errors(), strict=True)
    ]
    return Report(sections, results, errors={f"adapt, {options.kind} fish": errors})
