"""Log of swims: a resumed experiment gets those that it requests again, and swims the others."""

import csv
from pathlib import Path

import pytest

from fishd.config import Config
from fishd.core.errors import ConfigError
from fishd.core.signals import Tick
from fishd.lab.experiment import Header, open_experiment
from fishd.lab.session import VirtualSession
from fishd.lab.swim_log import SWIMS, SwimLog


def swim(path: Path, *frequencies: float) -> list[list[float]]:
    """Swim square waves, logged in a folder; return the forces of each."""

    def forces(ticks: list[Tick]) -> list[float]:
        return [tick.fx for tick in ticks]

    header = Header(kind="measure", on="live")
    with (
        open_experiment(path, header, resume=path.exists()) as experiment,
        VirtualSession(Config()) as rig,
        rig.recorded(experiment.recording("measure"), "") as writer,
        rig.logged(SwimLog(experiment, writer, rig.tick).swim),
    ):
        return [forces(rig.swim("square", {"frequency": f}, 2.0)) for f in frequencies]


def rows(path: Path) -> list[str]:
    table = csv.DictReader((path / SWIMS).read_text().splitlines())
    return [row["parameters"] for row in table]


def test_swims_are_taken_from_the_log_until_another_one_is_requested(tmp_path: Path) -> None:
    path = tmp_path / "run"
    first = swim(path, 1.0, 2.0, 2.5)
    assert swim(path, 1.0, 2.0, 2.5) == first
    changed = swim(path, 1.0, 1.5)
    assert changed[0] == first[0]
    assert rows(path) == ['{"frequency":1.0}', '{"frequency":1.5}']
    longer = swim(path, 1.0, 1.5, 2.0)
    assert longer[:2] == changed
    assert len(rows(path)) == 3


def test_swims_whose_ticks_are_lost_are_swum_again_and_that_is_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "run"
    swim(path, 1.0, 2.0)
    for recording in path.glob("*.mcap*"):
        recording.unlink()
    before = (path / SWIMS).read_text()
    swim(path, 1.0)
    assert (path / f"dropped-{SWIMS}").read_text() == before
    said = "swims.csv has ticks that no recording has: 2 swims and rests of the log are swum again"
    assert said in caplog.text


@pytest.mark.parametrize(("column", "value"), [("first_tick", "xx"), ("recording", "a\0b")])
def test_a_damaged_row_is_one_line_with_its_number(tmp_path: Path, column: str, value: str) -> None:
    path = tmp_path / "run"
    swim(path, 1.0)
    table = list(csv.DictReader((path / SWIMS).read_text().splitlines()))
    table[0][column] = value
    text = "".join(f"{','.join(map(_quoted, line))}\n" for line in (table[0], table[0].values()))
    (path / SWIMS).write_text(text)
    with pytest.raises(ConfigError, match=r"swims\.csv:2: .*; delete this line and those after it"):
        swim(path, 1.0)


def _quoted(cell: str) -> str:
    return '"' + cell.replace('"', '""') + '"'
