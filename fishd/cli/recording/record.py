"""The verbs that record a running fish, also with its camera, and the always-on black box."""

import re
import shutil
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import click
from msgspec.structs import asdict

from fishd.cli.options import Utf8Text, endpoint_option, for_option, json_option
from fishd.cli.output import echo, format_count, print_json
from fishd.cli.prompts import caught_signals
from fishd.cli.recording.files import folder_option
from fishd.client import Fish
from fishd.core import text
from fishd.core.errors import FishError, NoDaemon, RecordingError
from fishd.recording import RunWriter
from fishd.recording.black_box import BlackBox
from fishd.recording.folder import ensure_folder, open_new, recording_path
from fishd.recording.recorder import MIN_FREE_BYTES, Position, Recorder

if TYPE_CHECKING:
    from fishd.camera.tap import CameraTap

UNIT_BYTES = {"MB": 10**6, "GB": 10**9}
INCOMPLETE = 3
"""Exit status of a recorder that lost ticks or frames, or may have."""
DISK_RETRY_S = 10.0
"""Time until a black box tries again to write to its disk [s]."""
MIN_BLACK_BOX_BYTES = 10**7
"""Smallest size of a black box [bytes]."""
MAX_BLACK_BOX_BYTES = 10**15
"""Largest size of a black box [bytes]."""


class BlackBoxSize(click.ParamType[int]):
    """Size such as `500MB` or `2GB`, in bytes."""

    name = "size"

    def convert(
        self, value: str | int, param: click.Parameter | None, ctx: click.Context | None
    ) -> int:
        """Convert a text to a number of bytes."""
        if isinstance(value, int):
            return value
        match = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?) ?(MB|GB)", value.strip(), re.IGNORECASE)
        size = float(match[1]) * UNIT_BYTES[match[2].upper()] if match else 0.0
        if not MIN_BLACK_BOX_BYTES <= size <= MAX_BLACK_BOX_BYTES:
            quoted = text.quoted(value)
            self.fail(
                f"'{quoted}' is not valid: 10MB to 1000000GB is needed, such as 2GB", param, ctx
            )
        return round(size)


class _Record(click.Command):
    """Verb whose `--camera` may stand alone: the next word is an address if it looks like one."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse arguments; a file of settings after `--camera` is refused as an address."""
        words = []
        for word, next_word in pairwise([*args, ""]):
            stands_alone = "://" not in next_word and not next_word.endswith((".yaml", ".yml"))
            words.append("--camera=" if word == "--camera" and stands_alone else word)
        return super().parse_args(ctx, words)


@click.command(cls=_Record)
@click.argument("run", required=False)
@endpoint_option
@folder_option
@click.option(
    "--operator", type=Utf8Text(), default="", help="Name of the operator; default: this user."
)
@click.option("--subject", type=Utf8Text(), default="", help="Name or number of the fish.")
@click.option("--note", type=Utf8Text(), default="", help="Purpose of the recording.")
@for_option("End by itself after this time [s]; by default it ends when it is stopped.")
@json_option
@click.option(
    "--camera",
    metavar="[ADDRESS]",
    help="Record the frames of a camera, too: that with the request address ADDRESS, else "
    "$FISHD_CAMERA, else that of this machine.",
)
@click.option(
    "--black-box",
    is_flag=True,
    help="Record without end, a file an hour, and remove the oldest; waits for a fishd.",
)
@click.option(
    "--keep",
    type=BlackBoxSize(),
    default="2GB",
    show_default=True,
    help="Total size of all files of the black box.",
)
def record(
    run: str | None,
    endpoint: str | None,
    folder: Path,
    operator: str,
    subject: str,
    note: str,
    seconds: float | None,
    camera: str | None,
    black_box: bool,
    keep: int,
    as_json: bool,
) -> None:
    """Record a running fish: every tick, event and status.

    Ctrl-C or SIGTERM ends it. RUN is a name in the folder of recordings or a path; by default the
    date and time. The recording survives a restart of fishd. No older recording is ever
    overwritten.

    Exit status: 0 if every tick is in the file; 3 if ticks or frames were lost, or may have been,
    as a line then says; 1 if the recording could not begin or the disk failed. A black box reports
    losses, and ends with 0.
    """
    if black_box and run:
        raise click.UsageError("--black-box names its files itself: leave RUN out")
    if black_box and camera is not None:
        raise click.UsageError("a black box keeps no frames: they would fill it within hours")
    begin = partial(RunWriter, operator=operator, subject=subject, note=note)
    if black_box:
        place = ensure_folder(folder)
        box = BlackBox(place, keep, begin)

        def has_room() -> bool:
            try:  # the folder may be gone, such as that of a disk that was removed
                place.mkdir(parents=True, exist_ok=True)
                return shutil.disk_usage(place).free > 2 * MIN_FREE_BYTES
            except OSError:
                return False

        def open_recorder(after: Position | None) -> Recorder:
            return Recorder(endpoint, box.open, tell=_print_line, after=after, due=box.due)

        with caught_signals() as stopping:
            _record_endlessly(open_recorder, has_room, stopping, seconds, as_json)
        return
    with ExitStack() as stack:
        tap = None
        if camera is not None:
            from fishd.camera.tap import CameraTap

            tap = stack.enter_context(CameraTap(camera or None, endpoint))
        _record_one(run, endpoint, folder, begin, seconds, as_json, tap)


def _record_one(
    run: str | None,
    endpoint: str | None,
    folder: Path,
    begin: Callable[[Path], RunWriter],
    seconds: float | None,
    as_json: bool,
    camera: "CameraTap | None",
) -> None:
    """Record until a signal, or until a time has passed.

    begin: opens the recording at a path; seconds: longest duration [s]
    """
    place = ensure_folder(folder)
    progress = _draw if sys.stdout.isatty() and not as_json else lambda writer: None
    open_writer = (
        partial(begin, recording_path(run, place)) if run else partial(open_new, place, begin)
    )
    recorder = Recorder(endpoint, open_writer, tell=_print_line, progress=progress, camera=camera)
    try:
        with caught_signals() as stopping, recorder:
            echo(f"recording to {recorder.writer.path}; Ctrl-C ends it", err=as_json)
            if (mode := recorder.status.mode) != "running":
                clearing = "fishctl clear-fault, then " if mode in ("fault", "estop") else ""
                _print_line(
                    f"the fish is at rest (mode {mode}); it swims with: {clearing}fishctl "
                    "set-controller"
                )
            recorder.run(partial(stopping, 0.0), seconds)
    except RecordingError as error:
        if recorder.began:
            _mark_in_fishd(endpoint, f"recording {recorder.writer.path.name} ended: {error}")
        raise
    finally:
        if recorder.began:
            _end_line()
            _print_summary(recorder, as_json)
    if not recorder.is_complete:
        sys.exit(INCOMPLETE)


def _record_endlessly(
    open_recorder: Callable[[Position | None], Recorder],
    has_room: Callable[[], bool],
    stopping: Callable[[float], bool],
    seconds: float | None,
    as_json: bool,
) -> None:
    """Wait for a fishd, record it, and continue after its restarts and failures of the disk.

    Raise `RecordingError` if the first file cannot be written, or if none can at the end.
    """
    waiting, failure = False, None
    position: Position | None = None
    while not stopping(0.0):
        recorder = open_recorder(position)
        try:
            with recorder:
                echo(f"recording to {recorder.writer.path}", err=as_json)
                failure = None
                recorder.run(partial(stopping, 0.0), seconds)
                return
        except NoDaemon as error:
            if not waiting:
                _print_line(f"waiting: {error}")
            waiting = True
            stopping(1.0)
        except RecordingError as error:
            position = recorder.position
            if position is None:
                raise
            if failure is None:
                _print_line(f"{error}; the black box tries again every {DISK_RETRY_S:.0f} s")
            failure = error
            stopping(DISK_RETRY_S)
            while not (has_room() or stopping(0.0)):
                stopping(DISK_RETRY_S)
    if failure:
        raise failure


def _print_line(line: str) -> None:
    _end_line()
    echo(f"fishctl: {line}", err=True)


def _draw(writer: RunWriter) -> None:
    click.echo(f"\r{_format_amount(writer)}", nl=False)


def _end_line() -> None:
    if sys.stdout.isatty():
        click.echo("\r\x1b[K", nl=False)


def _print_summary(recorder: Recorder, as_json: bool) -> None:
    """Print the contents of a recording that has ended."""
    writer, is_complete = recorder.writer, recorder.is_complete
    if as_json:
        facts = {"path": str(writer.path), "bytes": writer.size, "complete": is_complete}
        print_json({**facts, **asdict(writer.summary)})
        return
    unknown = "; perhaps more are lost, as another line says" if recorder.has_unknown_losses else ""
    echo(f"{writer.path.name}: {_format_amount(writer)}{unknown}")


def _format_amount(writer: RunWriter) -> str:
    summary = writer.summary
    frames = format_count(summary.frames, "frame")
    return ", ".join(
        (
            f"{summary.duration:.1f} s",
            format_count(summary.ticks, "tick"),
            f"{summary.lost_ticks} lost",
            *([frames, f"{summary.lost_frames} lost"] if summary.frames else []),
            format_count(summary.events, "event"),
            f"{writer.size / 1e3:.0f} kB",
        )
    )


def _mark_in_fishd(endpoint: str | None, message: str) -> None:
    """Put a message into the event stream, which operators watch."""
    with suppress(FishError), Fish(endpoint) as fish:
        fish.mark(text.line(message))
