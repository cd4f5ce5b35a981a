"""The verb that compares policies and controllers on the same simulated fish."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fishd.cli.completion import complete_contestant
from fishd.cli.output import echo, print_json
from fishd.cli.simulate import run_options
from fishd.config import load

if TYPE_CHECKING:
    from rich.table import Table

    from fishd.learning.compare.comparison import Standing

WIDE = 1000
_HEADS = ("mN", "Hz", "|φ_c|/Φ", "square")


@click.command()
@click.argument(
    "contestants", nargs=-1, metavar="[POLICY|CONTROLLER]...", shell_complete=complete_contestant
)
@run_options
@click.option(
    "--seeds",
    type=click.IntRange(1, 1000),
    default=1,
    show_default=True,
    help="Runs of each contestant, with different noise.",
)
@click.option(
    "--png",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Draw command, fin, force and efficiency into this file.",
)
def evaluate(
    contestants: tuple[str, ...],
    file: Path | None,
    overrides: tuple[str, ...],
    seconds: float,
    settle: float,
    seeds: int,
    png: Path | None,
    as_json: bool,
) -> int:
    """Compare policies and controllers on the same simulated fish.

    A contestant is the name of a policy (see `fishctl policies`), an .onnx file, or a controller
    with parameters, such as swing:C=0.6 or square:frequency=1.7,amplitude=0.3. Without any: the
    best square wave, swing, and the named policies that are made for this fish.

    Efficiency is the thrust over that of the best square wave. |φ_c|/Φ is the mean size of the
    command, square its mean size over its rms: square wave 1, sine 0.900, triangle 0.866. Exit
    status 1 when one is refused on this fish, such as a policy for another amplitude, or ends in
    mode fault; the others swim all the same.
    """
    from fishd.learning.compare import comparison

    config = load(file, overrides)
    chosen = [comparison.parse(text) for text in contestants]
    chosen = chosen or comparison.default_contestants(config)
    refused = [(one, why) for one in chosen if (why := comparison.refusal(config, one))]
    able = [one for one in chosen if one not in (out for out, _ in refused)]
    standings, traces = comparison.compare(config, able or chosen, seconds, settle, seeds)
    if png:
        from fishd.learning.compare.figures import picture

        picture(png, standings, traces, config.amplitude_limit)
    if as_json:
        print_json(standings)
    else:
        from rich.console import Console

        # In a file or a pipe nothing is wrapped.
        Console(width=None if sys.stdout.isatty() else WIDE).print(_table(standings))
    for one, why in refused:
        echo(f"fishctl: {one.label}: refused: {why}", err=True)
    for standing in standings:
        for took_over in standing.fallbacks:
            echo(f"fishctl: {standing.contestant}: another took over: {took_over}", err=True)
    faults = [(standing.contestant, fault) for standing in standings for fault in standing.faults]
    for contestant, fault in faults:
        echo(f"fishctl: {contestant}: a run ended in mode fault: {fault}", err=True)
    return 1 if faults or refused else 0


def _table(standings: "list[Standing]") -> "Table":
    from rich.table import Table

    runs = standings[0].runs
    best = {
        (run.best_square_thrust, run.best_square_frequency)
        for standing in standings
        for run in standing.runs
    }
    caption = None
    if len(best) == 1:
        ((thrust, frequency),) = best
        caption = f"The best square wave: {thrust * 1e3:.2f} mN at {frequency:.3f} Hz."
    several = len(runs) > 1
    table = Table(caption=caption, caption_justify="left", box=None, pad_edge=False)
    table.add_column("contestant", overflow="fold")
    for head in ("efficiency", *(["lowest – highest"] if several else []), *_HEADS):
        table.add_column(head, justify="right", no_wrap=True)
    for standing in standings:
        spread = f"{standing.lowest_efficiency:.1%} – {standing.highest_efficiency:.1%}"
        table.add_row(
            standing.contestant,
            f"{standing.efficiency:.1%}",
            *([spread] if several else []),
            f"{standing.thrust * 1e3:.2f}",
            f"{standing.frequency:.3f}",
            f"{standing.fullness:.3f}",
            f"{standing.squareness:.3f}",
        )
    return table
