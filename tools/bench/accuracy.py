"""Errors of all results that have an interval, in half-widths of their 95 % intervals.

The other benches keep their errors in docs/figures/accuracy.csv when they write; this one prints
how many are inside, and draws how they are distributed.
"""

from argparse import Namespace

import numpy as np

from common.report import ERRORS, Options, Report, read_errors, table
from fishd.lab.drawing import BLACK, open_figure, plain

PICTURE = ERRORS.with_suffix(".svg")
MAX_SHOWN = 3.0
"""Largest error on the axis of the figure [half-widths]."""
OPTIONS: Options = {}


def measure(options: Namespace) -> Report:
    """Return the table; with --write the figure is drawn, too."""
    errors = read_errors()
    if options.write:
        draw(errors)
    rows = [
        [
            kind,
            str(len(values)),
            f"{np.mean(np.abs(values) <= 1.0):.0%}",
            f"{np.mean(np.abs(values) <= 2.0):.0%}",
            f"{np.max(np.abs(values)):.1f}",
        ]
        for kind, values in errors.items()
    ]
    head = "result | intervals | contain the truth | within 2 half-widths | largest error"
    return Report({"bench accuracy": table(head, rows)}, errors)


def draw(errors: dict[str, list[float]]) -> None:
    """Draw the share of the errors up to each size, beside that of a normal distribution."""
    from scipy.stats import norm

    with open_figure(PICTURE, (7.0, 4.2)) as figure:
        axis = figure.subplots()
        sizes = np.linspace(0.0, MAX_SHOWN, 301)
        ideal = 2.0 * norm.cdf(norm.ppf(0.975) * sizes) - 1.0
        axis.plot(sizes, 100.0 * ideal, color=BLACK, linestyle="--", label="normal distribution")
        for kind, values in errors.items():
            ordered = np.sort(np.abs(values))
            shares = np.searchsorted(ordered, sizes, side="right") / len(ordered)
            axis.plot(sizes, 100.0 * shares, linewidth=1.2, label=plain(kind))
        axis.axvline(1.0, color=BLACK, linewidth=0.5)
        axis.axhline(95.0, color=BLACK, linewidth=0.5)
        axis.set_xlim(0.0, MAX_SHOWN)
        axis.set_ylim(0.0, 101.0)
        axis.set_xlabel("error, in half-widths of its 95 % interval")
        axis.set_ylabel("share of the results (%)")
        axis.legend(fontsize="small", loc="lower right")
