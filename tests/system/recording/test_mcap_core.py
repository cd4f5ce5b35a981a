"""Recordings read by @mcap/core, with which Foxglove and Lichtblick open files."""

import json
import shutil
from pathlib import Path
from typing import Any

import msgspec
import pytest
from rigs.processes import call
from rigs.recordings import record_run, swum

from fishd.recording import RunWriter

NODE = shutil.which("node")
SCRIPT = Path(__file__).parents[2] / "rigs" / "read_mcap.cjs"

pytestmark = pytest.mark.skipif(
    NODE is None, reason="node is not installed, which @mcap/core needs"
)


def read(path: Path) -> dict[str, Any]:
    assert NODE
    done = call(NODE, SCRIPT, path)
    assert (done.returncode, done.stderr) == (0, "")
    contents: dict[str, Any] = json.loads(done.stdout)
    return contents


def test_a_recording_has_all_its_messages_for_the_library_of_foxglove(tmp_path: Path) -> None:
    rig = swum()
    contents = read(record_run(rig, tmp_path / "run", operator="Ada", flush_every=20))
    indexed, messages = contents["indexed"], contents["indexed"]["messages"]
    assert contents["stream"]["done"]
    for topic, sent in (("tick", rig.recorder.ticks), ("event", rig.recorder.events)):
        assert [data for _, data in messages[topic]] == [msgspec.to_builtins(one) for one in sent]
        assert [time for time, _ in messages[topic]] == pytest.approx([one.t * 1e9 for one in sent])
    assert contents["stream"]["counts"]["Message"] == len(rig.recorder.messages)
    assert ["tick", "json", "fishd.Tick", "jsonschema", "object"] in indexed["channels"]
    assert ["event", "json", "fishd.Event", "jsonschema", "object"] in indexed["channels"]
    assert indexed["metadata"]["fishd.run"]["operator"] == "Ada"
    assert indexed["metadata"]["fishd.end"]["reason"] == "ended"
    assert "amplitude_limit" in indexed["attachments"]["config.yaml"]


def test_of_an_unfinished_recording_all_that_was_flushed_is_read(tmp_path: Path) -> None:
    rig = swum()
    with RunWriter(tmp_path / "run") as writer:
        writer.describe(rig.config)
        for tick in rig.recorder.ticks[:40]:
            writer.tick(tick)
        writer.flush()
        contents = read(writer.part)
    assert not contents["stream"]["done"]
    assert contents["indexed"] is None
    assert contents["stream"]["counts"]["Message"] == 40
