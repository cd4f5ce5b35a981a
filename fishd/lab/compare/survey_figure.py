"""Figure of a survey: relative thrust of each contestant on each fish."""

from collections.abc import Sequence
from pathlib import Path

from fishd.lab.compare.survey import ContestantSurvey
from fishd.lab.drawing import BLACK, BLUE, GREEN, GREY, ORANGE, PURPLE, open_figure, plain

_COLOURS, _MARKERS = (BLUE, ORANGE, GREEN, PURPLE, BLACK), "osD^v"


def draw(path: Path, surveys: Sequence[ContestantSurvey]) -> None:
    """Draw a row for each fish, and in it a mark for each contestant; raises `FishdError`."""
    names = [result.fish for result in surveys[0].fish]
    with open_figure(path, (6.4, 1.1 + 0.2 * len(names))) as figure:
        axis = figure.subplots()
        for place, surveyed in enumerate(surveys):
            axis.plot(
                [100.0 * result.relative_thrust for result in surveyed.fish],
                range(len(names)),
                linestyle="",
                marker=_MARKERS[place % len(_MARKERS)],
                color=_COLOURS[place % len(_COLOURS)],
                alpha=0.8,
                label=plain(surveyed.contestant),
            )
        axis.axvline(100.0, color=GREY, linewidth=0.7, linestyle="--")
        axis.set_yticks(range(len(names)), names)
        axis.invert_yaxis()
        axis.grid(axis="y", color="0.9", linewidth=0.5)
        axis.set_xlabel("thrust, % of the best square wave of the same fish")
        figure.legend(loc="outside lower center", ncols=2)
