"""Refusals and output of the verbs about recordings."""

import json
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from rigs.harness import Rig
from rigs.processes import fishctl, one_line
from rigs.recordings import record_run, swum

from fishd.core.camera_frames import FrameHead
from fishd.recording import RunWriter


@pytest.mark.parametrize("length", ["nan", "inf", "-inf", "0"])
def test_a_recording_has_a_length_that_ends(tmp_path: Path, length: str) -> None:
    refused = fishctl("record", "--for", length, "--folder", str(tmp_path))
    assert refused.returncode == 2
    assert "'--for'" in one_line(refused)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("size", ["1MB", "9" * 400 + "GB", "2000000GB", "2"])
def test_a_black_box_has_a_size_that_a_disk_can_have(tmp_path: Path, size: str) -> None:
    refused = fishctl("record", "--black-box", "--keep", size, "--folder", str(tmp_path))
    assert refused.returncode == 2
    assert one_line(refused).endswith(
        "is not valid: 10MB to 1000000GB is needed, such as 2GB; see 'fishctl record --help'\n"
    )


def test_times_and_forces_that_cannot_be_are_listed_in_few_digits(tmp_path: Path) -> None:
    (tick, *_) = swum(0.2).recorder.ticks
    with RunWriter(tmp_path / "run") as writer:
        writer.tick(tick)
        later = replace(tick, seq=tick.seq + 1, thrust=-1e300)
        writer._add("tick", later, msgspec.json.encode(later))
        writer.tally.tick(later, 1e300)
    listed = fishctl("runs", "--folder", str(tmp_path)).stdout
    assert "1e+300 s" in listed
    assert max(map(len, listed.splitlines())) < 120


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of which one chunk, of ten ticks, cannot be read."""
    path = record_run(swum(), tmp_path_factory.mktemp("runs") / "run", flush_every=10)
    content = bytearray(path.read_bytes())
    content[int(0.4 * len(content))] ^= 0x55
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("verb", "more"),
    [
        ("export", ["--csv", "--to"]),
        ("rerun", ["--folder"]),
        pytest.param("plot", ["--to"], marks=pytest.mark.slow),
    ],
)
def test_every_verb_says_what_a_damaged_recording_lacks(
    damaged: Path, tmp_path: Path, verb: str, more: list[str]
) -> None:
    done = fishctl(verb, str(damaged), *more, str(tmp_path))
    assert done.returncode == 0
    assert done.stderr == f"fishctl: {damaged}: damaged: 10 ticks lost\n"


def test_a_damaged_recording_is_listed_as_one_and_recovered(damaged: Path) -> None:
    folder = str(damaged.parent)
    assert "damaged: 10 ticks lost" in fishctl("runs", "--folder", folder).stdout
    (listed,) = json.loads(fishctl("runs", "--json", "--folder", folder).stdout)
    assert (listed["ticks"], listed["recorded_ticks"], listed["lost_ticks"]) == (50, 60, 10)
    assert listed["problem"] == "damaged: 10 ticks lost"
    done = fishctl("recover", "run", "--folder", folder)
    assert done.stdout.startswith(f"{folder}/run-recovered.mcap: ")
    assert done.stdout.endswith("; damaged: 10 ticks lost\n")


def test_what_is_recovered_is_said_with_its_frames(tmp_path: Path) -> None:
    writer = RunWriter(tmp_path / "run")
    writer.describe(Rig().config)
    for tick in swum(0.5).recorder.ticks:
        writer.tick(tick)
    for seq in (1, 2, 3):
        head = FrameHead(tick.t, tick.time, tick.time, seq, "one", 0.01, 0)
        writer.frame(head, np.zeros((16, 16), np.uint8))
    writer.flush()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(writer.part.read_bytes())
    writer.close()
    done = fishctl("recover", str(cut))
    assert done.returncode == 0, done.stderr
    assert re.search(r" s, \d+ ticks, 0 lost, 0 events, 3 frames\n$", done.stdout)


def test_where_no_controller_swam_nothing_is_chosen_again(tmp_path: Path) -> None:
    rig = Rig()
    rig.run_for(0.5)
    path = record_run(rig, tmp_path / "run")
    done = fishctl("rerun", str(path))
    assert done.returncode == 1
    assert done.stderr == f"fishctl: {path}: no controller swam, so none can choose again\n"


@pytest.mark.parametrize("verb", ["export --csv", "plot", "replay", "rerun", "recover"])
@pytest.mark.parametrize("run", ["~nobody-here", "~nobody-here/run", "~nobody\0here"])
def test_a_home_of_nobody_is_one_line_of_every_verb(tmp_path: Path, verb: str, run: str) -> None:
    done = fishctl(*verb.split(), run, "--folder", str(tmp_path))
    assert done.returncode == 1
    assert "fishctl: no recording '~nobody" in one_line(done)
