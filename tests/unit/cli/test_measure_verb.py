"""`fishctl measure` and its picture: refused in time, and no result is lost by it."""

from pathlib import Path
from typing import Any

import msgspec
import pytest
from rigs.processes import fishctl, one_line

from fishd.core.errors import FishdError

SIMULATED = ("measure", "swing", "--on", "simulation", "--for", "21")


@pytest.mark.parametrize("where", [SIMULATED, ("measure", "swing")])
def test_a_picture_that_cannot_be_written_is_refused_before_anything_swims(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: tuple[str, ...]
) -> None:
    monkeypatch.setattr("fishd.lab.measurement.measure", lambda *_: pytest.fail("swims"))
    done = fishctl(*where, "--plot", str(tmp_path / "nowhere" / "x.png"))
    assert "does not exist" in one_line(done)


def test_what_was_measured_is_printed_though_its_picture_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise FishdError("x.png: the figure cannot be written: No space left on device")

    monkeypatch.setattr("fishd.lab.measurement_figure.draw", full)
    done = fishctl(*SIMULATED, "--json", "--plot", str(tmp_path / "x.png"))
    assert msgspec.json.decode(done.stdout)["thrust"] == pytest.approx(25.47e-3, abs=1e-4)
    assert (done.returncode, done.stderr.count("\n")) == (1, 2)
    assert "No space left" in done.stderr


def test_what_makes_a_thrust_doubtful_is_in_its_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fishd.lab.measurement._find_remark", lambda _: "the fin was not steady")
    line = fishctl(*SIMULATED).stdout.splitlines()[-1]
    assert "mN" in line
    assert line.endswith("; careful: the fin was not steady")
