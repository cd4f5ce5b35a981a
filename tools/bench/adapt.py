"""Quality of the choice and of the claim of `fishctl adapt`, on harsh fish that differ from the
model.

The fish are like those of the bench `swing`, with other seeds and with all effects of a real rig,
in random sizes. `adapt` runs on each in virtual time, by default for five minutes of tank time. The
truth is the mean thrust of the simulated fish, which `adapt` does not use.
"""

import os
import statistics
from argparse import Namespace
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from bench.swing import percent
from common.report import Options, Report, progress, table
from fishd.config import Start, load
from fishd.lab.experiment import Header, open_experiment
from fishd.lab.other_fish import harsh
from fishd.lab.session import VirtualSession
from fishd.learning.adapt.adaptation import Adaptation
from fishd.learning.adapt.state import AdaptFolder, Contender
from fishd.learning.adapt.verdict import SQUARE
from fishd.virtual.plant.optimum import best_square_wave

DOCUMENT = "how-to/adapt.md"
FIRST_SEED = 900
"""First seed of the harsh fish; other seeds were used during development."""
FISH = 10


class Adapted(Struct, frozen=True):
    """Result for one fish."""

    seed: int
    best: float
    """Thrust of the best square wave [N]."""
    chosen: str
    decided: bool
    """Whether the measurement alone shows that the chosen gait is the best one."""
    undecided: list[str]
    """Gaits that may be the best one according to the measurement."""
    explained: float
    """Fraction of the variance that the identified fish explains, for the worse explained force."""
    share: float
    """True thrust of the chosen gait over `best`."""
    of_square: float
    """True thrust of the square wave of the search, over `best`."""
    claimed: tuple[float, float, float]
    """Thrust of the chosen gait relative to the square wave of the search, and its interval."""
    claims: dict[str, tuple[float, float, float, float]]
    """`claimed` with the true value, for each gait except the square wave."""
    thrusts: dict[str, tuple[float, float, float, float]]
    """Measured thrust, half-widths of its statistical and total 95 % confidence intervals, and true
    thrust, by gait [N]."""
    tank_time: float
    """Duration of the adaptation [s]."""


class _Silent:
    """Progress display without output."""

    def done(self, line: str, amount: float) -> None:
        """Ignore the end of a step."""

    def at(self, amount: float, outcome: str = "") -> None:
        """Ignore progress."""

    def warn(self, line: str) -> None:
        """Ignore a warning."""


def adapted(task: tuple[int, int, float]) -> Adapted:
    """Adapt to one fish; task: seed, steps of the training, tank time [s]."""
    seed, steps, tank_time = task
    config = replace(load(None, harsh(seed).overrides), start=Start())
    header = Header(kind="adapt", on="simulation")
    with (
        TemporaryDirectory() as folder,
        VirtualSession(config) as session,
        open_experiment(Path(folder) / "adapt", header) as experiment,
    ):
        run = AdaptFolder(experiment)
        state = Adaptation(session, run, tank_time, steps, 0, _Silent()).run()
    assert state.verdict
    assert state.fitted
    contenders = {one.name: one for one in state.contenders}
    best = best_square_wave(config.plant, config.amplitude_limit).thrust
    verdict, square = state.verdict, contenders[SQUARE]
    progress(f"fish {seed}", verdict.claim)
    return Adapted(
        seed=seed,
        best=best,
        chosen=verdict.chosen,
        decided=verdict.decided,
        undecided=verdict.undecided,
        explained=state.fitted.model.explained,
        share=truth(contenders[verdict.chosen]) / best,
        of_square=truth(square) / best,
        claimed=(verdict.relative_thrust, verdict.low, verdict.high),
        claims={
            name: (*claim, truth(contenders[name]) / truth(square))
            for name, claim in verdict.others.items()
        },
        thrusts={
            one.name: (
                one.thrust,
                one.error,
                one.error if one.total_ci95 is None else one.total_ci95,
                truth(one),
            )
            for one in state.contenders
        },
        tank_time=state.tank_time,
    )


def truth(one: Contender) -> float:
    """Return the true thrust [N]."""
    assert one.true_thrust is not None
    return one.true_thrust


OPTIONS: Options = {
    "--jobs": {"type": int, "default": os.cpu_count(), "help": "processes"},
    "--first": {"type": int, "default": FIRST_SEED, "help": "seed of the first fish"},
    "--fish": {"type": int, "default": FISH, "help": "how many"},
    "--steps": {"type": int, "default": 6400, "help": "of each training"},
    "--budget": {"type": float, "default": 300.0, "help": "of each fish [s]"},
}


def measure(options: Namespace) -> Report:
    """Return two tables; takes half a minute per fish."""
    seeds = range(options.first, options.first + options.fish)
    tasks = [(seed, options.steps, options.tank_time) for seed in seeds]
    with ProcessPoolExecutor(options.jobs) as pool:
        results = list(pool.map(adapted, tasks))
    head = (
        "fish | best square wave, mN | verdict | true thrust of the chosen gait, % of the best | "
        "of the square wave found, % of the best | chosen gait ÷ square wave found, measured, % | "
        "the same, true, % | tank time, s"
    )
    rows = [row(each) for each in results]
    names = {"bench adapt": table(head, rows), "bench adapt summary": summary(results)}
    return Report(names, [msgspec.to_builtins(each) for each in results])


def row(one: Adapted) -> list[str]:
    """Return the row of the table for one fish."""
    value, low, high = map(percent, one.claimed)
    own = one.claims.get(one.chosen)
    return [
        str(one.seed),
        f"{1e3 * one.best:.2f}",
        f"{one.chosen} wins" if one.decided else _undecided(one),
        percent(one.share),
        percent(one.of_square),
        f"{value} [{low}, {high}]" if own else "100, the same gait",
        percent(own[3]) if own else "100",
        f"{one.tank_time:.0f}",
    ]


def _undecided(one: Adapted) -> str:
    """Return the undecided gaits, with the chosen one in bold."""
    return ", ".join(f"**{name}**" if name == one.chosen else name for name in one.undecided)


def summary(results: list[Adapted]) -> str:
    """Return medians, worst values and coverage."""
    shares = [each.share for each in results]
    claims = [each.claims[each.chosen] for each in results if each.chosen in each.claims]
    every = [claim for each in results for claim in each.claims.values()]
    policies = [
        each.thrusts["policy"][3] / each.best for each in results if "policy" in each.thrusts
    ]
    thrusts = [thrust for each in results for thrust in each.thrusts.values()]
    decided = [each for each in results if each.decided]
    lost = [1.0 - each.thrusts[each.chosen][3] / _largest(each) for each in results]
    # Differences by rounding between equal gaits are ignored.
    kept = [
        max(each.thrusts[k][3] for k in each.undecided) > 0.9999 * _largest(each)
        for each in results
    ]
    rows = [
        [
            "chosen gait, % of the best square wave, median",
            f"{percent(statistics.median(shares))} %",
        ],
        ["chosen gait, % of the best square wave, worst", f"{percent(min(shares))} %"],
        ["policies that took part", f"{len(policies)} of {len(results)}"],
        ["verdicts that name a winner", f"{len(decided)} of {len(results)}"],
        [
            "winners that are truly the best of the three",
            f"{sum(kept[results.index(each)] for each in decided)} of {len(decided)}",
        ],
        [
            "verdicts that include the truly best gait",
            f"{sum(kept)} of {len(results)}",
        ],
        [
            "loss of the chosen gait against the truly best, median",
            f"{percent(statistics.median(lost))} %",
        ],
        ["the same, worst", f"{percent(max(lost))} %"],
        ["interval of the chosen gait's relative thrust contains the true value", _covered(claims)],
        ["the same, all gaits except the square wave", _covered(every)],
        *(
            [
                f"{name} of a thrust contains the true value",
                f"{sum(abs(each[0] - each[3]) <= each[column] for each in thrusts)} of "
                f"{len(thrusts)}",
            ]
            for column, name in enumerate(("statistical interval", "total interval"), 1)
        ),
        ["longest tank time", f"{max(each.tank_time for each in results):.0f} s"],
    ]
    if policies:
        middle = f"{percent(statistics.median(policies))} %"
        rows.insert(2, ["policy, % of the best square wave, median", middle])
        rows.insert(3, ["policy, % of the best square wave, worst", f"{percent(min(policies))} %"])
    return table("quantity | measured", rows)


def _largest(one: Adapted) -> float:
    """Return the largest true thrust of the three [N]."""
    return max(true for *_, true in one.thrusts.values())


def _covered(claims: list[tuple[float, float, float, float]]) -> str:
    covered = sum(low <= true <= high for _, low, high, true in claims)
    return f"{covered} of {len(claims)}"
