"""The report of an adaptation: one picture, and one page that needs no network."""

import base64
import math
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from fishd.core.old_names import rename_keys
from fishd.lab import error_budget
from fishd.lab.drawing import BLACK, BLUE, GREEN, GREY, ORANGE, open_figure
from fishd.lab.identification.figure import format_estimate
from fishd.lab.identification.fit import LOGARITHMIC
from fishd.lab.identification.result import Estimate
from fishd.lab.ranking import format_ratio
from fishd.learning.adapt.state import (
    PAGE,
    PICTURE,
    TRAINING,
    AdaptFolder,
    Contender,
    Fitted,
    State,
    Verdict,
)
from fishd.learning.adapt.verdict import NAMES, SQUARE
from fishd.learning.run_folder.figure import draw_training
from fishd.virtual.plant.optimum import square_wave

_COLOURS = {"policy": BLUE, "swing": GREEN, SQUARE: ORANGE}
_STYLE = """body { font: 15px/1.5 sans-serif; margin: 2em auto; max-width: 60em; padding: 0 1em; }
table { border-collapse: collapse; margin: 1em 0; } th { text-align: left; }
td, th { border-bottom: 1px solid #ddd; padding: 0.2em 1em 0.2em 0; }
img { max-width: 100%; } .claim { font-size: 1.3em; } code { background: #f3f3f3; }"""


def write(run: AdaptFolder, amplitude: float, again: str) -> tuple[Path, Path]:
    """Draw the picture, and write the page and the result; return the paths of the first two.

    amplitude: Φ [rad]; again: command line that runs the chosen gait
    Raises `FishdError` where one cannot be written.
    """
    picture = run.path / PICTURE
    draw(run, amplitude, picture)
    run.experiment.write(PAGE, page(run.state, picture.read_bytes(), again))
    run.experiment.write_result(_result(run.state))
    return picture, run.path / PAGE


def _result(state: State) -> dict[str, Any]:
    """Return the measurement of the chosen gait, and the gait in words."""
    assert state.verdict
    gait = next(gait for gait in state.contenders if gait.name == state.verdict.chosen_gait)
    measured = {name: getattr(gait, name) for name in ("thrust", "thrust_ci95", "total_ci95")}
    return measured | {"summary": " ".join(["chosen:", *gait_words(gait)])}


def gait_words(gait: Contender) -> list[str]:
    """Return a gait as fishctl takes it: its controller, and its parameters as options."""
    words = [gait.controller]
    for name, value in gait.parameters.items():
        shown = f"{value:.6g}" if isinstance(value, float) else str(value)
        words += [f"--{name.replace('_', '-')}", shown]
    return words


def draw(run: AdaptFolder, amplitude: float, path: Path) -> None:
    """Draw fit, search, training and comparison, a panel each; amplitude: Φ [rad]."""
    state = run.state
    assert state.fitted
    trained = state.trained.folder if state.trained else ""
    with open_figure(path, (10.0, 7.0)) as figure:
        (fit, search), (training, contest) = figure.subplots(2, 2)
        _draw_fit(fit, state.fitted)
        _draw_search(search, state, amplitude)
        draw_training(training, run.path / (trained or TRAINING))
        _draw_contest(contest, state)


def _draw_fit(axis: Any, fitted: Fitted) -> None:
    """Draw the intervals of the parameters that are fitted as logarithms, as in the page's table.

    Others may be near zero, so they have no relative error. Where an interval is narrower if K_y/K
    is the configured one, that is drawn over it. One that is withheld has no bar.
    """
    shown = [
        (name, estimate)
        for name, estimate in _read_estimates(fitted)
        if estimate.get("fitted", True) and name in LOGARITHMIC and name != "lateral_inertia_ratio"
    ]
    bars = {}
    for place, (_, estimate) in enumerate(shown):
        whole = estimate["ci95_low"], estimate["ci95_high"]
        narrow = estimate.get("if_ratio_holds") or (None, None)
        for (low, high), colour, label in (
            (whole, GREY, "95 %"),
            (narrow, BLUE, "95 %, if K_y/K is as configured"),
        ):
            if low is not None and high is not None:
                ends = [100.0 * (end / estimate["value"] - 1.0) for end in (low, high)]
                bars[label] = axis.barh(
                    -place, ends[1] - ends[0], left=ends[0], color=colour, height=0.6
                )
    axis.legend(bars.values(), bars, fontsize="small", loc="upper right")
    axis.set_yticks([-place for place in range(len(shown))], [name for name, _ in shown])
    axis.set_xscale("symlog", linthresh=1.0)
    axis.set_xlabel("95 % interval, % from the value")
    axis.set_title("the fish, as fitted")


def _draw_search(axis: Any, state: State, amplitude: float) -> None:
    """Draw the tried square waves, and those of the identified fish."""
    assert state.fitted
    tried = [trial.frequency for trial in state.trials]
    frequencies = np.geomspace(0.9 * min(tried), 1.1 * max(tried), 60)
    curves = [
        [1e3 * square_wave(plant, amplitude, f).thrust for f in frequencies.tolist()]
        for plant in state.fitted.cloud[:8]
    ]
    for curve in curves[1:]:
        axis.plot(frequencies, curve, color=GREY, linewidth=0.6)
    if curves:
        axis.plot(frequencies, curves[0], color=BLACK, label="identified fish, and its cloud")
    axis.errorbar(
        tried, [1e3 * trial.thrust for trial in state.trials],
        yerr=[1e3 * trial.thrust_ci95 for trial in state.trials], fmt="o", color=ORANGE,
        markersize=4, elinewidth=0.8, capsize=2, label="tried, 95 %",
    )  # fmt: skip
    axis.set_xlabel("frequency (Hz)")
    axis.set_ylabel("thrust (mN)")
    axis.set_title("square waves")
    axis.legend(loc="upper right")


def _draw_contest(axis: Any, state: State) -> None:
    """Draw the thrusts measured on the fish."""
    for place, contender in enumerate(state.contenders):
        axis.errorbar(
            1e3 * contender.thrust, -place, xerr=1e3 * contender.thrust_ci95, fmt="o", capsize=3,
            color=_COLOURS[contender.name],
        )  # fmt: skip
        if contender.true_thrust is not None:
            axis.plot(1e3 * contender.true_thrust, -place, "x", color=BLACK, zorder=3)
    axis.set_yticks(
        [-place for place in range(len(state.contenders))],
        [contender.name for contender in state.contenders],
    )
    axis.set_ylim(0.5 - len(state.contenders), 0.5)
    known = any(contender.true_thrust is not None for contender in state.contenders)
    axis.set_xlabel("thrust, measured, 95 % statistical (mN)" + ("; ×: true" if known else ""))
    axis.set_title("in the tank")


def page(state: State, picture: bytes, again: str) -> str:
    """Return the page, which contains the picture."""
    assert state.fitted
    assert state.verdict
    image = base64.b64encode(picture).decode()
    remarks = [*state.fitted.identification["remarks"]]
    remarks += [f"{NAMES[name]} was left out: {why}" for name, why in state.exclusions.items()]
    if line := error_budget.unknown_calibration(state.contenders[0].calibration_ci95, "N"):
        remarks.append(line)
    remarks += [
        f"{NAMES[contender.name]}: {contender.remark}"
        for contender in state.contenders
        if contender.remark
    ]
    if state.trained and state.trained.refusal:
        remarks.append(f"no policy took part: {state.trained.refusal}")
    minutes = " + ".join(f"{seconds:.0f} s {step}" for step, seconds in state.step_times.items())
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8"><title>fishctl adapt</title>',
        f"<style>{_STYLE}</style></head><body>",
        "<h1>A fish and its best gait</h1>",
        f'<p class="claim">{escape(_sentence(state.verdict.claim))}</p>',
        f"<p>{state.tank_time:.0f} s of tank time: {escape(minutes)}.</p>",
        f"<p>Command for this gait: <code>{escape(again)}</code></p>",
        f'<img alt="fit, search, training, comparison" src="data:image/png;base64,{image}">',
        "<h2>In the tank</h2>",
        _table(*_contenders(state)),
        "<p>Relative thrust is the share of that of the best square wave tried; the "
        "intervals hold together in 95 % of cases. The error of the force sensor's "
        "calibration is the same fraction of all thrusts, so it does not affect a share.</p>",
        "<h2>The fish</h2>",
        _table(("", "value", "95 % interval", "unit"), _estimates(state.fitted)),
        *([f"<h2>Careful</h2><ul>{''.join(map(_item, remarks))}</ul>"] if remarks else []),
        "</body></html>",
    ]
    return "\n".join(parts) + "\n"


def _sentence(words: str) -> str:
    return f"{words[0].upper()}{words[1:]}."


def _item(words: str) -> str:
    return f"<li>{escape(words)}</li>"


def _contenders(state: State) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
    """Return the head and the rows of the table of measured gaits."""
    assert state.verdict
    known = any(contender.true_thrust is not None for contender in state.contenders)
    head = ("gait", "thrust", "Hz", "relative thrust", *(("true thrust",) if known else ()))
    rows = []
    for contender in state.contenders:
        share = state.verdict.relative_thrusts.get(contender.name)
        relative_thrust = "100 %"
        if share:
            relative_thrust = format_ratio(share)
        row = [
            NAMES[contender.name] + _role(contender.name, state.verdict),
            error_budget.format_with_budget(
                contender.thrust,
                contender.thrust_ci95,
                contender.calibration_ci95,
                contender.total_ci95,
                "N",
            ),
            f"{contender.frequency:.3f}",
            relative_thrust,
        ]
        if known:
            true = contender.true_thrust
            row.append("" if true is None else f"{1e3 * true:.2f} mN")
        rows.append(tuple(row))
    return head, rows


def _role(name: str, verdict: Verdict) -> str:
    """Return the role of a gait in the verdict, as a suffix to its name."""
    if name not in verdict.undecided_gaits:
        return ""
    if verdict.is_decided:
        return ", wins"
    return ", chosen" if name == verdict.chosen_gait else ", undecided"


def _read_estimates(fitted: Fitted) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the fitted parameters, also those of an older fishd."""
    for name, values in fitted.identification["estimates"].items():
        yield name, rename_keys("estimate", values)


def _estimates(fitted: Fitted) -> list[tuple[str, ...]]:
    """Return the rows of the fitted parameters, as `fishctl identify` prints them."""
    rows = []
    for name, values in _read_estimates(fitted):
        if values.get("fitted", True):
            # JSON has no infinity: null stands for an end that the data do not determine.
            low = -math.inf if values["ci95_low"] is None else values["ci95_low"]
            high = math.inf if values["ci95_high"] is None else values["ci95_high"]
            narrow = values.get("if_ratio_holds")
            narrow = (narrow[0], narrow[1]) if narrow else None
            estimate = Estimate(name, values["value"], low, high, if_ratio_holds=narrow)
            *row, unit = format_estimate(estimate)
            rows.append((*row, unit or "–"))
    return rows


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    def line(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return f"<table>{line(head, 'th')}{''.join(line(row, 'td') for row in rows)}</table>"
