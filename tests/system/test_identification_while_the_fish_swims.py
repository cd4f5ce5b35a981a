"""`fishctl identify --experiment` shows constants of the fish while it swims."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from rigs.processes import Daemon, Process, wait_until

from common.daemon import list_children
from fishd.cli import identify
from fishd.cli.progress import Lines
from fishd.config import load
from fishd.core.experiments import PROGRESS_VARIABLE, CurvePoint, Estimate
from fishd.lab import session
from fishd.lab.identification import experiment
from fishd.lab.session import VirtualSession
from fishd.recording import open_run

EARLY = f"""
import fishd.cli.identify as verb
verb.FIRST_FIT_S = {(FIRST_FIT_S := 10.0)}
from fishd.__main__ import fishctl
fishctl()
"""
"""Program of a fishctl with an early first fit."""


class Display(Lines):
    """Display that keeps each report."""

    def __init__(self) -> None:
        super().__init__(err=True)
        self.reports: list[tuple[dict[str, Estimate], CurvePoint]] = []

    def estimate(self, estimates: Sequence[Estimate], point: CurvePoint | None = None) -> None:
        assert point
        self.reports.append(({each.name: each for each in estimates}, point))


def swim(folder: Path, patch: pytest.MonkeyPatch, *overrides: str, options: Any = ()) -> Display:
    """Swim an experiment in virtual time, which waits for the end of each fit."""
    patch.setattr(subprocess.Popen, "poll", subprocess.Popen.wait)
    patch.setattr(session, "FLUSH_INTERVAL_S", 0.0)
    config, display = load(None, overrides), Display()
    with VirtualSession(config) as rig, rig.recorded(folder / "identify.mcap", "a test"):
        run = cast(Any, SimpleNamespace(session=lambda: rig, folder=folder))
        fits = identify.EarlyFits(run, load(), options, display, 0.0)
        with closing(fits), rig.heard_by(fits):
            assert len(experiment(rig, 32.0)) == 640
    return display


def test_intervals_shrink_around_the_constants_of_the_fish(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reports = swim(tmp_path, monkeypatch, "plant.omega0=11").reports
    lengths = [point.x for _, point in reports]
    assert lengths == pytest.approx([20.0, 30.0], abs=0.2)
    for estimates, point in reports:
        assert [*estimates] == ["omega0", "xi", "servo_speed", "thrust_coefficient * coupling^2"]
        frequency = estimates["omega0"]
        assert frequency.low is not None
        assert frequency.high is not None
        assert point.y == frequency.value == pytest.approx(11.0, rel=0.01)
        assert point.ci95 == pytest.approx(0.5 * (frequency.high - frequency.low))
        assert (point.y_name, point.unit) == ("omega0", "rad/s")
    widths = [point.ci95 or 0.0 for _, point in reports]
    assert widths == sorted(widths, reverse=True)


@pytest.mark.parametrize(
    ("overrides", "options"),
    [
        (("simulation.noise=1", "plant.thrust_coefficient=1e-6", "plant.lateral_drag=1e-6"), ()),
        ((), ("--fit=servo_delay",)),
    ],
    ids=["a sensor that sees no fish", "no shown constant is fitted"],
)
def test_what_is_not_known_is_not_shown(
    overrides: Sequence[str],
    options: Sequence[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(identify, "FIRST_FIT_S", 40.0)
    assert swim(tmp_path, monkeypatch, *overrides, options=options).reports == []


def test_a_signal_during_a_fit_leaves_no_process_and_all_ticks(
    daemon: Daemon, tmp_path: Path
) -> None:
    folder, errors = tmp_path / "run", tmp_path / "errors"
    words = ("identify", "--experiment", "--on", "live", "--for", "600", "--folder", str(folder))
    with errors.open("w") as file:
        swims = Process(
            *(sys.executable, "-P", "-c", EARLY, "--endpoint", daemon.endpoint, *words),
            stderr=file,
            env=os.environ | {PROGRESS_VARIABLE: "json"},
        )
    with swims:
        wait_until(lambda: '"estimates":' in errors.read_text())
        fits: list[int] = []
        wait_until(lambda: bool(fits.extend(list_children(swims.pid)) or fits))
        assert swims.end(signal.SIGINT)[0] == 130
        assert not any(Path(f"/proc/{fit}").exists() for fit in fits)
    assert "Traceback" not in errors.read_text()
    assert daemon.status().mode == "idle"
    run = open_run(folder / "identify.mcap")
    assert run.gaps == []
    assert run.summary.swim_ticks["excitation"] * daemon.status().tick > FIRST_FIT_S - 5.0
