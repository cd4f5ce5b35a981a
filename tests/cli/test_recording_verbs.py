"""What the verbs about recordings refuse and say."""

from pathlib import Path

import pytest
from msgspec.structs import replace
from rigs.processes import fishctl, one_line
from rigs.recordings import swum

from fishd.recording import RunWriter


@pytest.mark.parametrize("length", ["nan", "inf", "-inf", "0"])
def test_a_recording_has_a_length_that_ends(tmp_path: Path, length: str) -> None:
    refused = fishctl("record", "--for", length, "--folder", str(tmp_path))
    assert refused.returncode == 2
    assert "'--for'" in one_line(refused)
    assert list(tmp_path.iterdir()) == []


def test_times_and_forces_that_cannot_be_are_listed_in_few_digits(tmp_path: Path) -> None:
    (tick, *_) = swum(0.2).recorder.ticks
    with RunWriter(tmp_path / "run") as writer:
        writer.tick(tick)
        writer.tally.tick(replace(tick, seq=tick.seq + 1, t=1e300, thrust=-1e300))
    listed = fishctl("runs", "--folder", str(tmp_path)).stdout
    assert "1e+300 s" in listed
    assert max(map(len, listed.splitlines())) < 120
