"""Frames of a camera in a recording: what is written is what is read."""

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pandas
import pytest
from mcap.reader import make_reader
from msgspec.structs import replace
from rigs.filmed_swim import filmed, swum
from rigs.harness import Rig

from fishd.camera.simulated import DEFAULT
from fishd.core.camera_frames import Frame, FrameHead
from fishd.core.errors import RecordingError
from fishd.core.signals import Tick
from fishd.recording import RunWriter, open_run
from fishd.recording.export import export
from fishd.recording.folder import read_overview
from fishd.recording.recover import recover

UNIX = 1.7e9


@pytest.fixture(scope="module")
def ticks() -> list[Tick]:
    return [replace(tick, t=UNIX + tick.time) for tick in swum(5.0, controller="swing")]


@pytest.fixture(scope="module")
def frames(ticks: list[Tick]) -> list[Frame]:
    return filmed(ticks, replace(DEFAULT, rate=30.0))


def head(frame: Frame, seq: int, session: str = "one", dropped: int = 0) -> FrameHead:
    exposure = 0.01 if seq % 2 else None  # optional
    times = (UNIX + frame.time, frame.time, frame.available)
    return FrameHead(*times, seq, session, exposure, dropped)


def write(path: Path, ticks: list[Tick], frames: list[Frame], *, close: bool = True) -> Path:
    """Each frame once it is there, between the ticks, as a recorder gets them."""
    writer = RunWriter(path)
    writer.describe(Rig().config)
    waiting = list(enumerate(frames, start=1))
    for tick in ticks:
        writer.tick(tick)
        while waiting and waiting[0][1].available <= tick.time:
            seq, frame = waiting.pop(0)
            writer.frame(head(frame, seq), frame.pixels)
    for seq, frame in waiting:
        writer.frame(head(frame, seq), frame.pixels)
    if close:
        writer.close()
        return writer.path
    writer.flush()
    return writer.part


@pytest.fixture
def path(tmp_path: Path, ticks: list[Tick], frames: list[Frame]) -> Path:
    return write(tmp_path / "run.mcap", ticks, frames)


def test_pixels_and_times_are_returned(path: Path, ticks: list[Tick], frames: list[Frame]) -> None:
    run = open_run(path)
    recorded = list(run.frames())
    assert len(recorded) == len(frames) == len(run.frame_heads)
    for number, (frame, sent) in enumerate(zip(recorded, frames, strict=True), start=1):
        assert (frame.pixels == sent.pixels).all()
        assert (frame.time, frame.available) == (sent.time, sent.available)
        exposure = 0.01 if number % 2 else None
        assert (frame.seq, frame.session, frame.exposure) == (number, "one", exposure)
    assert run.ticks == ticks
    assert (run.summary.frames, run.summary.lost_frames) == (len(frames), 0)


def test_viewers_find_the_schema_that_they_know(path: Path, frames: list[Frame]) -> None:
    with path.open("rb") as file:
        reader = make_reader(file)
        messages = list(reader.iter_messages(topics=["camera"], log_time_order=False))
    assert len(messages) == len(frames)
    for (schema, channel, message), sent in zip(messages, frames, strict=True):
        assert schema is not None
        assert (schema.name, schema.encoding) == ("foxglove.CompressedImage", "jsonschema")
        assert channel.message_encoding == "json"
        content = json.loads(message.data)
        described = json.loads(schema.data)
        assert set(content) | {"exposure"} == set(described["properties"])
        assert None not in content.values()
        assert "anyOf" not in schema.data.decode()
        types = [described["properties"][name]["type"] for name in ("time", "seq", "session")]
        assert types == ["number", "integer", "string"]
        stamp = content["timestamp"]
        assert stamp["sec"] * 10**9 + stamp["nsec"] == message.publish_time
        assert message.log_time * 1e-9 == pytest.approx(UNIX + sent.time, abs=1e-6)
        assert content["format"] == "png"
        png = np.frombuffer(base64.b64decode(content["data"]), np.uint8)
        pixels = cv2.imdecode(png, cv2.IMREAD_UNCHANGED)
        assert pixels is not None
        assert (pixels == sent.pixels).all()


def test_an_hour_of_frames_has_the_size_that_the_docs_say(path: Path, tmp_path: Path,
                                                          ticks: list[Tick],
                                                          frames: list[Frame]) -> None:  # fmt: skip
    bare = write(tmp_path / "bare.mcap", ticks, [])
    frame_bytes = (path.stat().st_size - bare.stat().st_size) / len(frames)
    assert 4.0e3 < frame_bytes < 6.0e3


def test_missing_frames_and_a_new_camera_are_gaps(tmp_path: Path, frames: list[Frame]) -> None:
    with RunWriter(tmp_path / "run") as writer:
        writer.describe(Rig().config)
        heads = [
            head(frames[0], 1), head(frames[1], 2), head(frames[2], 5),
            head(frames[3], 6, dropped=3), head(frames[4], 1, session="two"),
        ]  # fmt: skip
        lost = [writer.frame(header, frames[0].pixels) for header in heads]
    assert lost == [0, 0, 2, 3, 0]
    for summary in (open_run(writer.path).summary, read_overview(writer.path).summary):
        assert (summary.frames, summary.lost_frames, summary.frame_gaps) == (5, 5, 3)


def test_a_recording_that_was_cut_off_is_finished_with_its_frames(
    tmp_path: Path, ticks: list[Tick], frames: list[Frame]
) -> None:
    part = write(tmp_path / "run.mcap", ticks, frames, close=False)
    copy = tmp_path / "cut.mcap"
    copy.write_bytes(part.read_bytes()[:-20000])
    run = recover(copy)
    recorded = list(run.frames())
    assert len(frames) > len(recorded) > len(frames) / 2
    assert all((a.pixels == b.pixels).all() for a, b in zip(recorded, frames, strict=False))
    assert run.summary.frames == len(recorded)


def test_frames_are_exported_as_one_array_with_a_table_of_their_times(
    path: Path, frames: list[Frame], tmp_path: Path
) -> None:
    written = export(open_run(path), tmp_path / "run.csv")
    names = ["run.csv", "run-events.csv", "run-frames.csv", "run-frames.npy"]
    assert [file.name for file in written] == names
    array = np.load(tmp_path / "run-frames.npy", mmap_mode="r")
    assert array.shape == (len(frames), 84, 84)
    assert all((pixels == frame.pixels).all() for pixels, frame in zip(array, frames, strict=True))
    times = pandas.read_csv(tmp_path / "run-frames.csv")
    assert list(times.time) == [frame.time for frame in frames]
    with pytest.raises(RecordingError, match="use --force to replace it"):
        export(open_run(path), tmp_path / "run.csv")


def test_frames_recorded_meanwhile_are_not_exported(tmp_path: Path, frames: list[Frame]) -> None:
    with RunWriter(tmp_path / "run") as writer:
        writer.describe(Rig().config)
        writer.frame(head(frames[0], 1), frames[0].pixels)
        writer.flush()
        run = open_run(writer.part)
        writer.frame(head(frames[1], 2), frames[1].pixels)
        writer.flush()
        assert len(list(run.frames())) == len(run.frame_heads) == 1
        export(run, tmp_path / "run.csv")
    assert np.load(tmp_path / "run-frames.npy").shape == (1, 84, 84)


def test_frames_of_several_sizes_are_no_array(tmp_path: Path, frames: list[Frame]) -> None:
    with RunWriter(tmp_path / "run") as writer:
        writer.describe(Rig().config)
        writer.frame(head(frames[0], 1), frames[0].pixels)
        writer.frame(head(frames[1], 2), frames[1].pixels[:40, :40].copy())
    with pytest.raises(RecordingError, match="frames of 84 x 84 px and of 40 x 40 px"):
        export(open_run(writer.path), tmp_path / "run.csv")
    assert not list(tmp_path.glob("*.part"))
