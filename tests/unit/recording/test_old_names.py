"""Recordings whose fields have the names that they had before version 2 of the protocol."""

from pathlib import Path
from typing import Any

import msgspec
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import Writer
from msgspec.structs import replace
from rigs.recordings import status, swum

from fishd.core.calibration import EXACT, ServoCalibration
from fishd.core.old_names import OLD_NAMES
from fishd.core.protocol import Calibrations
from fishd.core.signals import Event, Percentiles, Tick, Timing
from fishd.recording import RunWriter, open_run
from fishd.recording.folder import read_overview
from fishd.recording.mcap_file import read_records

OVERRUN = Event(1.0, "warning", "overrun", "late", {"seq": 3, "missed_slots": 2})


def with_old_names(kind: str, fields: dict[str, Any]) -> dict[str, Any]:
    before = {new: old for old, new in OLD_NAMES[kind].items()}
    return {before.get(name, name): value for name, value in fields.items()}


def old_message(topic: str, payload: bytes) -> bytes:
    message = msgspec.json.decode(payload)
    if topic == "event":
        message["data"] = with_old_names("event overrun", message["data"])
        return msgspec.json.encode(message)
    if topic == "status":
        timing = message["timing"]
        for part in (timing, timing["phases"]):
            for name in part.keys() - {"phases"}:
                part[name] = with_old_names("distribution", part[name])
        message["timing"] = with_old_names("timing", timing)
    return msgspec.json.encode(with_old_names(topic, message))


def write_with_old_names(path: Path, to: Path) -> Path:
    """Write a recording again as a fishd of before wrote it."""
    topics: dict[int, str] = {}
    with to.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="fishd")
        for record in read_records(path):
            if isinstance(record, Schema):
                writer.register_schema(record.name, record.encoding, record.data)
            elif isinstance(record, Channel):
                topics[record.id] = record.topic
                writer.register_channel(record.topic, record.message_encoding, record.schema_id)
            elif isinstance(record, Message):
                payload = old_message(topics[record.channel_id], record.data)
                writer.add_message(record.channel_id, record.log_time, payload, record.publish_time)
            elif isinstance(record, Metadata):
                kind = {"fishd.daemon": "daemon", "fishd.end": "summary"}.get(record.name)
                data = with_old_names(kind, record.metadata) if kind else record.metadata
                writer.add_metadata(record.name, data | ({} if kind else {"format": "1"}))
            elif isinstance(record, Attachment):
                content = record.data
                if record.name == "calibrations.json":
                    calibrations = msgspec.json.decode(content)
                    force = with_old_names("calibration", calibrations["force"])
                    content = msgspec.json.encode(calibrations | {"force": force})
                writer.add_attachment(0, 0, record.name, record.media_type, content)
        writer.finish()
    return to


def test_a_recording_with_old_names_is_read_as_one_of_today(tmp_path: Path) -> None:
    ticks = [
        replace(tick, thrust_ci95=0.001, thrust_factor_ci95=0.002, missed_slots=2, frequency=1.7)
        for tick in swum(1.0).recorder.ticks
    ]
    times = Percentiles(1.0, 2.0, 3.0, 4)
    timing = Timing(times, times, {"read": times})
    last = replace(
        status(ticks[-1], 7), recovered_errors={"i2c_errors": 1}, limitations=("slow",),
        missed_slots=2, boot_id="b", timing=timing,
    )  # fmt: skip
    with RunWriter(tmp_path / "new") as writer:
        writer.describe(swum(0.1).config, {"lowest_angle": "-0.4", "highest_angle": "0.3"})
        writer.calibrated(Calibrations(EXACT, None, ServoCalibration(), None, 1.0, on_trial=False))
        for message in (*ticks, OVERRUN):
            (writer.tick if isinstance(message, Tick) else writer.event)(message)  # type: ignore[arg-type]
        writer.status(last)
    new = open_run(writer.path)
    old = open_run(write_with_old_names(writer.path, tmp_path / "old.mcap"))
    assert (old.ticks, old.events, old.statuses) == (new.ticks, [OVERRUN], [last])
    assert (old.summary, old.daemons, old.calibrations) == (
        new.summary, new.daemons, new.calibrations,
    )  # fmt: skip
    assert old.summary.thrust_ci95
    assert read_overview(old.path).summary == new.summary
