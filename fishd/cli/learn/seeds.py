"""Several seeds of one training: what `fishctl learn ppo --seeds` shows of them."""

import statistics
from typing import TYPE_CHECKING

import click

from fishd.core.console import INTERRUPTED

if TYPE_CHECKING:
    from fishd.learning.train.jobs import Job, Outcome


def train_seeds(job: "Job", seeds: int, jobs: int | None, cluster: str | None) -> int:
    """Train them all, a line as each ends, and a summary; the exit status."""
    from fishd.learning.train import seeds as training

    click.echo(f"{job.folder}: {seeds} seeds of {job.last_step()} steps")
    outcomes = training.train_seeds(job, seeds, jobs, cluster, _print)
    for name, evaluations in (
        ("latest", [outcome.latest_evaluation for outcome in outcomes]),
        ("best", [outcome.best_evaluation for outcome in outcomes]),
    ):
        shares = [evaluation.efficiency for evaluation in evaluations if evaluation]
        if shares:
            click.echo(
                f"{name} policies of {len(shares)} seeds: median {statistics.median(shares):.1%} "
                f"[{min(shares):.1%} – {max(shares):.1%}]"
            )
    click.echo(f"curves: {job.folder / 'seeds.csv'}")
    ends = {outcome.ended for outcome in outcomes}
    if ends - {"finished", "interrupted"}:
        return 1
    return INTERRUPTED if "interrupted" in ends else 0


def _print(seed: int, outcome: "Outcome") -> None:
    from fishd.learning.train.progress import described

    latest = outcome.latest_evaluation
    swims = f": {described(latest).strip()}" if latest else ""
    is_finished = outcome.ended == "finished"
    ended = "" if is_finished else f" {outcome.ended}"
    why = f" ({outcome.message})" if outcome.message else ""
    click.echo(f"seed {seed}{ended}{why}{swims}", err=not is_finished)
