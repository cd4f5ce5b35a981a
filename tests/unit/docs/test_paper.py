"""Figures and numbers of the paper on the pages, against the tables, equations and loop."""

from collections.abc import Mapping
from typing import Any

import pytest

from common.report import DOCS, between
from fishd.lab.simulation import Report
from fishd.lab.swimmer import free_swim
from paper import claims, figure_3, figure_4, figure_5, figure_6, swing_map
from paper.runs import Run, read, swim


@pytest.mark.parametrize("name", claims.SECTIONS)
def test_the_page_says_what_tables_and_equations_give(name: str) -> None:
    assert between(DOCS / claims.DOCUMENT, name) == claims.section(name)


def test_the_page_about_the_criterion_says_what_the_map_gives() -> None:
    for document, name, text in swing_map.sections():
        assert between(DOCS / document, name) == text


def row(name: str, **having: str | float) -> dict[str, Any]:
    (match,) = read(name, **having)
    return match


def assert_same(report: Report, row: Mapping[str, Any]) -> None:
    """Check a report against a row of a table, within the rounding of other libraries."""
    if "thrust_mN" in row:
        assert 1e3 * report.mean_thrust == pytest.approx(row["thrust_mN"], rel=5e-3)
    else:
        assert report.relative_thrust == pytest.approx(row["relative_thrust"], abs=5e-3)


@pytest.mark.parametrize("wave", figure_4.WAVES)
@pytest.mark.parametrize("tick", figure_4.TICKS)
def test_waveforms_still_thrust_as_in_figure_4(wave: str, tick: float) -> None:
    swum = swim(figure_4.run(wave, tick, 1.8))
    assert_same(swum, row(figure_4.NAME, waveform=wave, tick_s=tick, frequency_Hz=1.8))


def test_swing_and_a_learned_policy_still_thrust_as_in_figure_3() -> None:
    for source, controller, parameters in (
        (figure_3.SWING, "swing", {"C": 0.6}),
        (figure_3.LEARNT, "ppo", {"policy": figure_3.policy(0.31)}),
    ):
        swum = swim(figure_3.run(controller, parameters, 0.31))
        assert_same(swum, row(figure_3.NAME, source=source, amplitude_rad=0.31))


def test_figure_6_has_every_swim_of_its_curves_and_at_least_ten_beats_of_each() -> None:
    assert all(case.row() for fish in figure_6.READINGS for case in figure_6.curves(fish))
    assert all(row["beats"] >= 10 for row in read(figure_6.NAME))


@pytest.mark.slow
def test_the_free_swimmer_begins_to_swim_as_it_did() -> None:
    """Check the first half second, on the coarsest grid of figure 6."""
    undamped = figure_6.config("undamped", 1.0)
    track = free_swim.swim(undamped, "square", {"frequency": 3.0}, 0.5, 0.1).track
    distance, speed = -track.rows()[:, 1], track.rows()[:, 3]
    assert distance[[166, 249]] == pytest.approx([7.1899e-3, 11.2430e-3], rel=1e-3)
    assert speed[249] == pytest.approx(27.232e-3, rel=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("run", "row"),
    [
        (figure_5.run(0.6, 0.9), row(figure_5.NAME, C=0.6, w0Phi_over_Omega=0.9)),
        (figure_5.inset_run(0.05, 0.0), row(figure_5.INSET, xi=0.05, C=0.0)),
    ],
    ids=["default fish", "fast servo"],
)
def test_swing_is_still_as_efficient_as_in_figure_5(run: Run, row: dict[str, Any]) -> None:
    assert_same(swim(run), row)
