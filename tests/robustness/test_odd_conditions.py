"""fishctl and fishd under odd conditions: the most important cells of the trial in tools/."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.processes import FISHD, PATIENCE, Daemon, call

from common.daemon import Fishd
from fishd.client import Fish
from reliability import odd_conditions

CONDITIONS = [name for name, condition in odd_conditions.CONDITIONS.items() if not condition.mounts]
Rig = tuple[Fishd, odd_conditions.Place]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    folder = tmp_path_factory.mktemp("odd")
    with Fishd("realtime.priority=0") as fishd:
        fishd.next_tick()
        yield fishd, odd_conditions.Place(folder / "folder", folder / "runs", folder / "none")


@pytest.mark.parametrize("condition", CONDITIONS)
def test_an_emergency_stop_passes_and_its_status_says_so(condition: str, rig: Rig) -> None:
    (cell,) = odd_conditions.try_group("estop", condition, *rig)
    assert not cell.wrong, cell.said
    assert cell.status == 0


@pytest.mark.parametrize(
    ("group", "condition"),
    [
        ("swim", "locale C"),
        ("look", "closed stdout"),
        ("look", "full stdout"),
        ("fishd", "closed stdout"),
        ("fishd", "deleted folder"),
        ("record", "full disk"),
    ],
)
def test_a_command_works_or_says_in_one_line_why_not(group: str, condition: str, rig: Rig) -> None:
    cells = list(odd_conditions.try_group(group, condition, *rig))
    if not all(cell.tried for cell in cells):
        pytest.skip("no file system may be mounted here")
    assert [f"{cell.command}: {cell.wrong}: {cell.said}" for cell in cells if cell.wrong] == []


@pytest.mark.parametrize("stream", [">/dev/full", ">&-"])
def test_a_version_that_cannot_be_written_is_one_line(stream: str) -> None:
    done = call("sh", "-c", f'"$0" --version {stream}', FISHD)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert done.stderr.startswith("fishd: the output cannot be written: ")


def test_bytes_that_are_no_text_do_not_keep_an_emergency_stop_from_passing(tmp_path: Path) -> None:
    with (
        Daemon(tmp_path).wait_until_up() as daemon,
        Fish(daemon.endpoint, timeout=PATIENCE) as fish,
    ):
        assert fish.estop(os.fsdecode(b"fin \xff")).mode == "estop"
        reason = fish.status().reason
    assert reason
    assert reason.message == "fin ?"
