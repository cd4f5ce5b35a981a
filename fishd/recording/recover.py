"""Finishes a recording that was cut off, by a kill or a power cut say."""

from pathlib import Path

from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from fishd.core.errors import RecordingError
from fishd.recording import images
from fishd.recording.mcap_file import records
from fishd.recording.part_file import (
    PART,
    SUFFIX,
    PartFile,
    give_name,
    held,
    is_being_written,
)
from fishd.recording.reader import TOPICS, Run, open_run
from fishd.recording.schemas import CHANNELS, json_schema, schema_name
from fishd.recording.summary import to_metadata
from fishd.recording.writer import CHUNK

RECOVERING = ".recovering"
"""Is added to the name of the copy until it is whole."""
UNFINISHED = "recovered: the recording was not finished"
DAMAGED = "recovered: the recording was damaged, ticks that could not be read: {}"


def recover(path: Path) -> Run:
    """Write what can be read of a recording into a finished one, and open that.

    `RUN.mcap.part` becomes `RUN.mcap`; what has another name stays, beside `NAME-recovered.mcap`.
    A kill costs nothing: the next call finishes what this one began.
    Raises `RecordingError` where there is nothing to recover, or no room to do so.
    """
    if is_being_written(path):
        raise RecordingError(f"{path} is being recorded now, or recovered; end that first")
    run = open_run(path)
    is_part = path.name.endswith(SUFFIX + PART)
    if not is_part and run.finished and not run.is_damaged:
        raise RecordingError(f"{path} is finished and whole: there is nothing to recover")
    final = path.with_name(run.name + ("" if is_part else "-recovered") + SUFFIX)
    try:
        with held(path):
            final.with_name(final.name + RECOVERING).unlink(missing_ok=True)  # left by a kill
            if is_part and run.finished and not run.is_damaged and not final.exists():
                give_name(path, final)  # it was killed just before
            elif not (is_part and _is_copy(final, run)):
                _write(run, final)
            if is_part:
                path.unlink(missing_ok=True)
    except OSError as error:
        raise RecordingError(f"{final} cannot be written: {error.strerror or error}") from None
    return open_run(final)


def _is_copy(final: Path, part: Run) -> bool:
    """Is there a whole recording of this run already, when a kill came before the end?"""
    if not final.exists():
        return False
    run = open_run(final)
    return run.finished and not run.is_damaged and run.about == part.about


def _write(run: Run, final: Path) -> None:
    if final.exists():
        raise RecordingError(f"{final} is there already; move it away first")
    file = PartFile(final, final.with_name(final.name + RECOVERING))
    try:
        _copy(run, file)
        file.finish()
    except BaseException:
        file.remove()
        raise
    finally:
        file.close()


def _copy(run: Run, file: PartFile) -> None:
    writer = Writer(file, CHUNK, CompressionType.ZSTD)  # type: ignore[arg-type]
    writer.start(profile="", library="fishd")
    if not run.about:  # that part is damaged
        writer.add_metadata("fishd.run", {"run": run.name})
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}

    def channel_of(number: int) -> int:
        if number not in channels:  # where its record is damaged
            topic = TOPICS[number]
            if topic in CHANNELS:
                name, schema = schema_name(CHANNELS[topic]), json_schema(CHANNELS[topic])
            else:
                name, schema = images.SCHEMA, images.json_schema()
            found = writer.register_schema(name, "jsonschema", schema)
            channels[number] = writer.register_channel(topic, "json", found)
        return channels[number]

    for record in records(run.path):
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
    reason = DAMAGED.format(run.damaged) if run.is_damaged else UNFINISHED
    writer.add_metadata("fishd.end", to_metadata(run.summary) | {"reason": reason})
    writer.flush()  # type: ignore[no-untyped-call]
    writer.finish()  # type: ignore[no-untyped-call]
    file.flush()
