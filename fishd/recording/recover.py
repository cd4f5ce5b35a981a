"""Recovery of a recording that was interrupted, for example by a kill or a power cut."""

from pathlib import Path

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from fishd.core.errors import RecordingError
from fishd.core.files import os_errors
from fishd.core.schema import json_schema, schema_name
from fishd.core.tail_reading import RecordedTail
from fishd.recording.images import IMAGE_SCHEMA, TAIL_TOPIC, image_json_schema
from fishd.recording.part_file import (
    PART_SUFFIX,
    SUFFIX,
    PartFile,
    is_being_written,
    lock_recording,
    rename_to_final,
)
from fishd.recording.reader import RECOVERED, TOPICS, UNFINISHED_REASON, Run, open_run
from fishd.recording.summary import to_metadata
from fishd.recording.writer import CHANNELS, CHUNK_BYTES

RECOVERING_SUFFIX = ".recovering"
"""Suffix of the name of the copy until it is complete."""


def recover(path: Path) -> Run:
    """Copy the readable part of a recording to a finished one, and open that.

    The reason of its end states what was damaged, or not as recorded.
    `RUN.mcap.part` becomes `RUN.mcap`; a file of another name is kept next to
    `NAME-recovered.mcap`. After a kill, the next call completes the recovery.
    Raise `RecordingError` if there is nothing to recover, or not enough space.
    """
    if is_being_written(path):
        raise RecordingError(f"{path} is being recorded or recovered; end that process first")
    run = open_run(path)
    is_part = path.name.endswith(SUFFIX + PART_SUFFIX)
    if not is_part and run.finished and run.is_as_recorded:
        raise RecordingError(f"{path} is finished and undamaged: there is nothing to recover")
    final = path.with_name(run.name + ("" if is_part else "-recovered") + SUFFIX)
    with os_errors(RecordingError, f"{final} cannot be written"), lock_recording(path):
        # Left by a kill.
        final.with_name(final.name + RECOVERING_SUFFIX).unlink(missing_ok=True)
        if is_part and run.finished and run.is_as_recorded and not final.exists():
            rename_to_final(path, final)  # the recorder was killed just before
        elif not (is_part and _is_copy(final, run)):
            _write(run, final)
        if is_part:
            path.unlink(missing_ok=True)
    return open_run(final)


def _is_copy(final: Path, part: Run) -> bool:
    """Return whether `final` is a complete copy of this run, left by a kill before the end."""
    if not final.exists():
        return False
    run = open_run(final)
    return run.finished and run.is_as_recorded and run.about == part.about


def _write(run: Run, final: Path) -> None:
    if final.exists():
        raise RecordingError(f"{final} already exists; move it away first")
    file = PartFile(final, final.with_name(final.name + RECOVERING_SUFFIX))
    try:
        _copy(run, file)
        file.finish()
    except BaseException:
        file.remove()
        raise
    finally:
        file.close()


def _copy(run: Run, file: PartFile) -> None:
    writer = Writer(file, CHUNK_BYTES, CompressionType.ZSTD)  # type: ignore[arg-type]
    writer.start(profile="", library="fishd")
    if not run.about:  # its metadata are damaged
        writer.add_metadata("fishd.run", {"run": run.name})
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}

    def channel_of(number: int) -> int:
        if number not in channels:  # the record of the channel is damaged
            topic = TOPICS[number]
            kind = RecordedTail if topic == TAIL_TOPIC else CHANNELS.get(topic)
            if kind:
                name, schema = schema_name(kind), json_schema(kind)
            else:
                name, schema = IMAGE_SCHEMA, image_json_schema()
            schema_id = writer.register_schema(name, "jsonschema", schema)
            channels[number] = writer.register_channel(topic, "json", schema_id)
        return channels[number]

    for _, record in run.records():
        if isinstance(record, Message) and (record.channel_id in {*channels, *TOPICS}):
            writer.add_message(
                channel_of(record.channel_id),
                record.log_time,
                record.data,
                record.publish_time,
                record.sequence,
            )
        elif isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels:
            channels[record.id] = writer.register_channel(
                record.topic,
                record.message_encoding,
                schemas.get(record.schema_id, 0),
                record.metadata,
            )
        elif isinstance(record, Metadata) and record.name != "fishd.end":
            writer.add_metadata(record.name, record.metadata)
        elif isinstance(record, Attachment):
            writer.add_attachment(
                record.create_time, record.log_time, record.name, record.media_type, record.data
            )
    reason = f"{RECOVERED}{run.problem}" if run.problem else UNFINISHED_REASON
    writer.add_metadata("fishd.end", to_metadata(run.summary) | {"reason": reason})
    writer.flush()  # type: ignore[no-untyped-call]
    writer.finish()  # type: ignore[no-untyped-call]
    file.flush()
