"""The verb that records a running fish, and the always-on black box."""

import re
import signal
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from msgspec.structs import asdict

from fishd.cli.options import Words, endpoint_option, for_option, json_option
from fishd.cli.output import counted, echo, print_json
from fishd.cli.recording.choice import folder_option
from fishd.client import Fish
from fishd.core import text
from fishd.core.errors import FishError, NoDaemon, RecordingError
from fishd.recording import RunWriter
from fishd.recording.black_box import BlackBox
from fishd.recording.folder import made, named, new_path, runs_folder
from fishd.recording.recorder import Recorder

if TYPE_CHECKING:
    from fishd.recording.camera_tap import CameraTap

F = TypeVar("F", bound=Callable[..., Any])
UNITS = {"MB": 10**6, "GB": 10**9}
LEAST = 10**7
"""A black box is no smaller than this [bytes]."""
MOST = 10**15
"""Nor larger [bytes]."""


class Size(click.ParamType[int]):
    """A size such as `500MB` or `2GB`, in bytes."""

    name = "size"

    def convert(
        self, value: str | int, param: click.Parameter | None, ctx: click.Context | None
    ) -> int:
        """Text to bytes."""
        if isinstance(value, int):
            return value
        found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?) ?(MB|GB)", value.strip(), re.IGNORECASE)
        size = float(found[1]) * UNITS[found[2].upper()] if found else 0.0
        if not LEAST <= size <= MOST:
            shown = text.quoted(value)
            self.fail(
                f"'{shown}' is not valid: 10MB to 1000000GB is needed, such as 2GB", param, ctx
            )
        return round(size)


def recording_options(function: F) -> F:
    """RUN, and the options of every verb that records."""
    for decorate in (
        json_option,
        for_option("End by itself after this time [s]; by default Ctrl-C ends it."),
        click.option("--note", type=Words(), default="", help="What for."),
        click.option("--subject", type=Words(), default="", help="Which fish, such as its number."),
        click.option(
            "--operator", type=Words(), default="", help="Who records; default: this user."
        ),
        folder_option,
        endpoint_option,
        click.argument("run", required=False),
    ):
        function = decorate(function)
    return function


class _Record(click.Command):
    """`--camera` may stand alone: what follows it is its address only where it looks like one."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """A file of settings is no RUN either; it is refused as an address."""
        words = []
        for word, after in pairwise([*args, ""]):
            alone = "://" not in after and not after.endswith((".yaml", ".yml"))
            words.append("--camera=" if word == "--camera" and alone else word)
        return super().parse_args(ctx, words)


@click.command(cls=_Record)
@recording_options
@click.option(
    "--camera",
    metavar="[ADDRESS]",
    help="The frames of the camera, too: of the one that takes requests at ADDRESS, else at "
    "$FISHD_CAMERA, else of this machine.",
)
@click.option(
    "--black-box",
    is_flag=True,
    help="Record for ever, a file an hour, and remove the oldest; waits for a fishd.",
)
@click.option(
    "--keep",
    type=Size(),
    default="2GB",
    show_default=True,
    help="Size of all files of the black box together.",
)
def record(
    run: str | None,
    endpoint: str | None,
    folder: Path | None,
    operator: str,
    subject: str,
    note: str,
    seconds: float | None,
    camera: str | None,
    black_box: bool,
    keep: int,
    as_json: bool,
) -> None:
    """Record a running fish: every tick, event and status, until Ctrl-C or SIGTERM.

    RUN is a name in the folder of recordings or a path; by default the date and time. The
    recording survives a restart of fishd. No older recording is ever overwritten.
    """
    if black_box and run:
        raise click.UsageError("--black-box names its files itself: leave RUN out")
    if black_box and camera is not None:
        raise click.UsageError("a black box keeps no frames: they would fill it within hours")
    begin = partial(RunWriter, operator=operator, subject=subject, note=note)
    if black_box:
        box = BlackBox(made(folder or runs_folder()), keep, begin)
        open_recorder = partial(Recorder, endpoint, box.open, tell=_tell, due=box.due)
        _record_for_ever(open_recorder, _Signals(), seconds, as_json)
        return
    if camera is None:
        record_one(run, endpoint, folder, begin, seconds, as_json)
        return
    from fishd.recording.camera_tap import CameraTap

    with CameraTap(camera or None, endpoint) as tap:
        record_one(run, endpoint, folder, begin, seconds, as_json, tap)


def record_one(
    run: str | None,
    endpoint: str | None,
    folder: Path | None,
    begin: Callable[[Path], RunWriter],
    seconds: float | None,
    as_json: bool,
    camera: "CameraTap | None" = None,
) -> None:
    """Record until a signal, or for so long [s].

    begin: opens the recording at a path
    """
    stopping = _Signals()
    place = made(folder or runs_folder())
    progress = _draw if sys.stdout.isatty() and not as_json else lambda writer: None
    path = named(run, place) if run else new_path(place)
    recorder = Recorder(
        endpoint, partial(begin, path), tell=_tell, progress=progress, camera=camera
    )
    try:
        with recorder:
            echo(f"recording to {recorder.writer.path}; Ctrl-C ends it", err=as_json)
            if (mode := recorder.status.mode) != "running":
                first = "fishctl clear-fault, then " if mode in ("fault", "estop") else ""
                _tell(
                    f"the fish is at rest (mode {mode}); it swims with: {first}fishctl "
                    "set-controller"
                )
            recorder.run(stopping, seconds)
    except RecordingError as error:
        if recorder.began:
            _tell_fishd(endpoint, f"recording {recorder.writer.path.name} ended: {error}")
        raise
    finally:
        if recorder.began:
            _end_line()
            _print(recorder.writer, as_json)


def _record_for_ever(
    open_recorder: Callable[[], Recorder],
    stopping: "_Signals",
    seconds: float | None,
    as_json: bool,
) -> None:
    """Wait for a fishd, record it, and go on after any restart of it."""
    waiting = False
    while not stopping():
        try:
            with open_recorder() as recorder:
                echo(f"recording to {recorder.writer.path}", err=as_json)
                recorder.run(stopping, seconds)
                return
        except NoDaemon as error:
            if not waiting:
                _tell(f"waiting: {error}")
            waiting = True
            stopping.wait(1.0)


class _Signals:
    """True once somebody asked for the end: Ctrl-C, SIGTERM, or a terminal that closes."""

    def __init__(self) -> None:
        self._asked = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if signal.getsignal(number) is not signal.SIG_IGN:  # as below nohup
                signal.signal(number, self._ask)

    def __call__(self) -> bool:
        return self._asked

    def wait(self, seconds: float) -> None:
        """Wait for a signal, but no longer than this."""
        if not self._asked:
            signal.sigtimedwait((), seconds)

    def _ask(self, *_: object) -> None:
        self._asked = True


def _tell(line: str) -> None:
    _end_line()
    echo(f"fishctl: {line}", err=True)


def _draw(writer: RunWriter) -> None:
    click.echo(f"\r{_amount(writer)}", nl=False)


def _end_line() -> None:
    if sys.stdout.isatty():
        click.echo("\r\x1b[K", nl=False)


def _print(writer: RunWriter, as_json: bool) -> None:
    """Print what a recording holds that has ended."""
    if as_json:
        print_json({"path": writer.path, "bytes": writer.size, **asdict(writer.summary)})
    else:
        echo(f"{writer.path.name}: {_amount(writer)}")


def _amount(writer: RunWriter) -> str:
    summary = writer.summary
    frames = counted(summary.frames, "frame")
    return ", ".join(
        (
            f"{summary.duration:.1f} s",
            counted(summary.ticks, "tick"),
            f"{summary.lost} lost",
            *([frames, f"{summary.frames_lost} lost"] if summary.frames else []),
            counted(summary.events, "event"),
            f"{writer.size / 1e3:.0f} kB",
        )
    )


def _tell_fishd(endpoint: str | None, what: str) -> None:
    """Put it into the event stream, where an operator looks."""
    with suppress(FishError), Fish(endpoint) as fish:
        fish.mark(text.line(what))
