"""Fin angles of a camera in a recording, and at the ticks."""

from pathlib import Path

import numpy as np
import pandas
import pytest
from msgspec.structs import replace
from rigs.filmed_swim import swum
from rigs.harness import Rig

from fishd.core.signals import Tick
from fishd.core.tail_reading import RecordedTail
from fishd.lab.run_figure import draw_run
from fishd.lab.run_traces import traces
from fishd.recording import RunWriter, open_run
from fishd.recording.export import export
from fishd.recording.fin_angle import interpolate
from fishd.recording.recover import recover

UNIX, RATE, ZERO = 1.7e9, 30.0, 0.01


@pytest.fixture(scope="module")
def ticks() -> list[Tick]:
    return [replace(tick, t=UNIX + tick.time) for tick in swum(5.0, controller="swing")]


def reading(time: float, alpha: float | None, seq: int = 1) -> RecordedTail:
    return RecordedTail(
        t=UNIX + time, time=time, alpha=alpha, zero=ZERO, uncertainty=0.002, seq=seq, session="one"
    )


def measured(ticks: list[Tick]) -> list[RecordedTail]:
    """Return the fin angles in pictures between the ticks, whose truth is a cubic spline."""
    from scipy.interpolate import CubicSpline

    truth = CubicSpline([tick.time for tick in ticks], [tick.alpha for tick in ticks])
    times = np.arange(ticks[0].time, ticks[-1].time, 1.0 / RATE)
    return [reading(time, float(truth(time)), seq) for seq, time in enumerate(times.tolist(), 1)]


def write(path: Path, ticks: list[Tick], tails: list[RecordedTail], *, close: bool = True) -> Path:
    """Write each fin angle after the tick before it, as a recorder does."""
    writer, waiting = RunWriter(path), list(tails)
    writer.describe(Rig().config)
    for tick in ticks:
        writer.tick(tick)
        while waiting and waiting[0].time <= tick.time:
            writer.tail(waiting.pop(0))
    if close:
        writer.close()
        return writer.path
    writer.flush()
    return writer.part


def test_fin_angles_are_read_as_they_were_written(tmp_path: Path, ticks: list[Tick]) -> None:
    tails = [*measured(ticks)[:20], replace(reading(1.0, None), reason="no tail", midline=())]
    run = open_run(write(tmp_path / "run", ticks, tails))
    assert run.tails == tails
    assert (run.summary.tails, run.problem, run.ticks) == (len(tails), "", ticks)


def test_a_recording_that_was_cut_off_keeps_them(tmp_path: Path, ticks: list[Tick]) -> None:
    tails = measured(ticks)[:40]
    part = write(tmp_path / "run", ticks[:60], tails, close=False)
    copy = tmp_path / "cut.mcap"
    copy.write_bytes(part.read_bytes())
    run = recover(copy)
    assert run.tails == tails
    assert run.finished


def test_at_the_ticks_they_are_the_true_fin_angle(ticks: list[Tick]) -> None:
    angles, errors = interpolate(measured(ticks), [tick.time for tick in ticks[:-1]])
    assert np.abs(angles - [tick.alpha for tick in ticks[:-1]]).max() < 2e-3
    assert set(errors) == {0.002}


def test_gaps_of_more_than_60_ms_have_no_fin_angle(ticks: list[Tick]) -> None:
    tails = measured(ticks)
    unknown = [replace(tail, alpha=None) for tail in tails[30:32]]
    at = tails[30].time
    angles, errors = interpolate([*tails[:30], *unknown, *tails[32:]], [at, at - 0.2, -1.0, 1e6])
    assert np.isnan(angles).tolist() == np.isnan(errors).tolist() == [True, False, True, True]
    angles, _ = interpolate([*tails[:31], *tails[32:]], [at])  # one of 60 a second would be missed
    assert not np.isnan(angles).any()
    one_missing, _ = interpolate([reading(0.0, 0.1), reading(0.07, 0.1)], [0.03])
    assert np.isnan(one_missing).all()


def test_no_fin_angle_at_all_is_known_nowhere() -> None:
    angles, errors = interpolate([reading(0.0, None)], [0.0])
    assert np.isnan([*angles, *errors]).all()


def test_an_export_has_them_in_two_columns(tmp_path: Path, ticks: list[Tick]) -> None:
    run = open_run(write(tmp_path / "run", ticks, measured(ticks)))
    table = pandas.read_csv(export(run, tmp_path / "run.csv")[0])
    inside = table[2:-2]
    assert np.abs(inside["fin_angle"] - inside["alpha"]).max() < 2e-3
    assert set(inside["fin_angle_uncertainty"]) == {0.002}
    without = open_run(write(tmp_path / "without", ticks, []))
    assert "fin_angle" not in without.frame().columns


@pytest.mark.slow
def test_a_figure_shows_them_beside_the_command(tmp_path: Path, ticks: list[Tick]) -> None:
    tails = measured(ticks)
    run = open_run(write(tmp_path / "run", ticks, [*tails[:30], *tails[40:]]))
    drawn = traces(run)
    assert drawn.fin is not None
    assert np.isnan(drawn.fin.alpha).sum() == 1  # the gap
    truth = np.array([float(tick.alpha) for tick in ticks])  # type: ignore[arg-type]
    assert drawn.fin.beats[-1].alpha_max == pytest.approx(np.abs(truth[-30:]).max(), rel=0.05)
    draw_run(drawn, tmp_path / "run.svg")
    picture = (tmp_path / "run.svg").read_text()
    assert "measured fin angle" in picture
    assert "fin angle over command" in picture
    assert traces(run, 0.5, 1.0).fin is not None
