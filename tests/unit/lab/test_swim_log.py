"""Log of swims: a resumed experiment gets those that it requests again, and swims the others."""

import csv
from pathlib import Path

from fishd.config import Config
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
