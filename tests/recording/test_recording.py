"""What is written is what is read, whatever happened to the writer."""

from pathlib import Path

import pytest
from rigs.harness import Rig

from fishd.core.errors import RecordingError
from fishd.recording import RunWriter, open_run, read


def swum(seconds: float = 3.0) -> Rig:
    """A virtual fish that has swum, and was retuned in the middle of it."""
    rig = Rig()
    rig.start("swing")
    rig.run_for(seconds / 2)
    rig.retune(C=0.3)
    rig.run_for(seconds / 2)
    return rig


def recorded(rig: Rig, path: Path, **about: str) -> Path:
    with RunWriter(path, **about) as writer:
        writer.describe(rig.config)
        for event in rig.recorder.events:
            writer.event(event)
        for tick in rig.recorder.ticks:
            writer.tick(tick)
    return writer.path


def test_a_recording_gives_back_every_bit_of_a_run(tmp_path: Path) -> None:
    rig = swum()
    path = recorded(rig, tmp_path / "run", operator="Ada", subject="fish 3", note="stiff fin")
    run = open_run(str(path))
    assert path.name == "run.mcap"
    assert run.ticks == rig.recorder.ticks
    assert run.events == rig.recorder.events
    assert run.config == rig.config
    assert {run.about[key] for key in ("operator", "subject", "note")} == {
        "Ada",
        "fish 3",
        "stiff fin",
    }
    assert run.finished
    assert (run.gaps, run.summary.swimming) == ([], {"swing": 60})
    table = read(path)
    assert list(table.fx) == [tick.fx for tick in rig.recorder.ticks]


def test_an_older_recording_is_never_overwritten(tmp_path: Path) -> None:
    path = recorded(swum(), tmp_path / "run.mcap")
    before = path.read_bytes()
    with pytest.raises(RecordingError, match="is there already; choose another name"):
        RunWriter(path)
    assert path.read_bytes() == before
