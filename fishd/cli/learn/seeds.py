"""Several seeds of one training: what `fishctl learn ppo --seeds` shows of them."""

import statistics
from typing import TYPE_CHECKING

import click

from fishd.cli.config import EX_CONFIG
from fishd.console import complain
from fishd.errors import ConfigError

if TYPE_CHECKING:
    from fishd.learning.jobs import Job
    from fishd.learning.seeds import SeedOutcome

INTERRUPTED = 130


def train_seeds(job: "Job", seeds: int, jobs: int | None, cluster: str | None) -> int:
    """Train them all, a line as each ends, and a summary; the exit status."""
    from fishd.learning import seeds as learning

    click.echo(f"{job.folder}: {seeds} seeds of {job.last_step()} steps")
    try:
        outcomes = learning.train_seeds(job, seeds, jobs, cluster, _tell)
    except ConfigError as error:
        complain("fishctl", str(error), EX_CONFIG)
    for name, found in (
        ("latest", [outcome.latest for outcome in outcomes if outcome.latest]),
        ("best", [outcome.best for outcome in outcomes if outcome.best]),
    ):
        if found:
            shares = [evaluation.efficiency for evaluation in found]
            click.echo(
                f"{name} policies of {len(shares)} seeds: median {statistics.median(shares):.1%} "
                f"[{min(shares):.1%} – {max(shares):.1%}]"
            )
    click.echo(f"curves: {job.folder / 'seeds.csv'}")
    ends = {outcome.ended for outcome in outcomes}
    if ends - {"finished", "interrupted"}:
        return 1
    return INTERRUPTED if "interrupted" in ends else 0


def _tell(outcome: "SeedOutcome") -> None:
    from fishd.learning.progress import described

    swims = f": {described(outcome.latest).strip()}" if outcome.latest else ""
    if outcome.ended == "finished":
        click.echo(f"seed {outcome.seed}{swims}")
        return
    why = f" ({outcome.message})" if outcome.message else ""
    click.echo(f"seed {outcome.seed} {outcome.ended}{why}{swims}", err=True)
