"""The verb that lets policies and controllers swim many other fish."""

import statistics
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fishd.cli.completion import complete_contestant
from fishd.cli.config import fish_options
from fishd.cli.controller_arguments import ControllersCommand
from fishd.cli.options import for_option, json_option, plot_option
from fishd.cli.output import echo, echo_table, print_json
from fishd.cli.progress import show_progress
from fishd.config import load

if TYPE_CHECKING:
    from rich.table import Table

    from fishd.lab.compare.survey import ContestantSurvey, FishResult


@click.command(cls=ControllersCommand)
@click.argument(
    "contestants",
    nargs=-1,
    required=True,
    metavar="POLICY|CONTROLLER...",
    shell_complete=complete_contestant,
)
@click.option(
    "--variation",
    type=click.Choice(["changes", "random", "harsh"]),
    default="harsh",
    show_default=True,
    help="How the fish differ. changes: one imperfection of a rig at a time; random: twenty fish "
    "with all of them, in random sizes; harsh: both.",
)
@for_option("Length of each run [s].", default=60.0, kind=click.FLOAT)
@click.option(
    "--settle",
    type=float,
    default=10.0,
    show_default=True,
    help="Time of each run before measurements begin [s].",
)
@plot_option("the thrust of each contestant on each fish")
@fish_options
@json_option
def evaluate(
    contestants: tuple[str, ...],
    variation: str,
    seconds: float,
    settle: float,
    file: Path | None,
    overrides: tuple[str, ...],
    picture: Path | None,
    as_json: bool,
) -> int:
    """Let policies and controllers swim many other fish, in virtual time.

    A contestant is a policy by name or file, or a controller with parameters, as for `fishctl
    compare`. Figures are fractions of the true thrust of the best square wave of the same fish. The
    fish differ from the configured one by the keys that --json shows. "another took over" counts
    the runs in which a policy was replaced because it kept reversing too fast; "longest
    chatter" is the longest stretch of reversals in consecutive ticks.
    Exit status 1 when a run ends in mode fault.
    """
    from fishd.lab import drawing
    from fishd.lab.compare import figures
    from fishd.lab.compare.contestants import parse_all
    from fishd.lab.compare.survey import CHANGES, harsh_fish, survey

    if picture:
        drawing.check(picture)
    parsed = parse_all(contestants)
    fish = list(CHANGES) if variation != "random" else []
    singles = len(fish)
    fish += harsh_fish() if variation != "changes" else ()
    configs = [(changed, load(file, (*overrides, *changed.overrides))) for changed in fish]
    with show_progress(len(parsed) * len(fish) * seconds, "s swum") as bar:
        surveys = survey(configs, parsed, seconds, settle, bar.at)
    if picture:
        figures.draw_survey(picture, surveys)
    if as_json:
        print_json(surveys)
    else:
        echo_table(_build_table(surveys, singles))
    faults = [(surveyed, run) for surveyed in surveys for run in surveyed.fish if run.fault]
    for surveyed, run in faults:
        echo(f"fishctl: {surveyed.contestant}: {run.fish}: ended in fault: {run.fault}", err=True)
    return 1 if faults else 0


def _build_table(surveys: "list[ContestantSurvey]", singles: int) -> "Table":
    """Return a table: a row for each of the first `singles` fish, and figures of all others."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column("fish", overflow="fold")
    for surveyed in surveys:
        table.add_column(surveyed.contestant, justify="right", overflow="fold")
    for row in range(singles):
        runs = [surveyed.fish[row] for surveyed in surveys]
        table.add_row(runs[0].fish, *(f"{run.relative_thrust:.1%}" for run in runs))
    harsh_runs = [surveyed.fish[singles:] for surveyed in surveys]
    if harsh_runs[0]:
        label = f"{len(harsh_runs[0])} harsh fish"
        table.add_row(
            f"{label}, median",
            *(f"{statistics.median(run.relative_thrust for run in row):.1%}" for row in harsh_runs),
        )
        table.add_row(
            f"{label}, worst",
            *(f"{min(run.relative_thrust for run in row):.1%}" for row in harsh_runs),
        )

    def add_figure(name: str, figure: "Callable[[list[FishResult]], str]") -> None:
        table.add_row(name, *(figure(surveyed.fish) for surveyed in surveys))

    add_figure("another took over", lambda row: f"{sum(run.fallback is not None for run in row)}")
    add_figure("longest chatter", lambda row: f"{max(run.longest_chatter_s for run in row):.1f} s")
    return table
