"""Options and helpers of the verbs about a camera: its address, pictures, and the fish."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import yaml

from fishd.cli.options import F, verb_lease
from fishd.cli.output import echo
from fishd.client import Fish
from fishd.core import files
from fishd.core.errors import FishdError, FishError, NoDaemon
from fishd.core.process.interruption import raise_on_first_signal
from fishd.core.signals import Event, Tick

if TYPE_CHECKING:
    from fishd.camera.client import CameraClient
    from fishd.camera.tail_watch import TailWatch
    from fishd.core.camera_frames import Frame
    from fishd.lab.session import LiveSession

THREAD_TIMEOUT_S = 1.0
"""Longest wait for the end of a thread [s]."""
camera_option = click.option(
    "--camera",
    "address",
    metavar="ADDRESS",
    help="Request address of the camera; default: $FISHD_CAMERA, else the one of this machine.",
)


def png_option(*, required: bool = False) -> Callable[[F], F]:
    """Return the option for the file of a picture."""
    return click.option(
        "--plot",
        "png",
        required=required,
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="FILE",
        help="PNG file for the picture.",
    )


def check_png(path: Path | None) -> None:
    """Raise `UsageError` if a picture cannot be written, before the verb does anything."""
    if path is None:
        return
    if path.suffix.lower() != ".png":
        raise click.UsageError(f"'{path}' is not valid for --plot: a name ending in .png is needed")
    try:
        files.check_writable(path)
    except files.FileProblem as problem:
        raise click.UsageError(f"'{path}' is not valid for --plot: {problem}") from None


def format_yaml(settings: dict[str, Any]) -> str:
    """Return YAML lines for a file of settings; dots in the keys separate sections."""
    data: dict[str, Any] = {}
    for key, value in settings.items():
        *sections, name = key.split(".")
        inner = data
        for section in sections:
            inner = inner.setdefault(section, {})
        inner[name] = value
    return yaml.safe_dump(data, sort_keys=False).rstrip()


class Watcher:
    """Collector of the frames that come while a fish swims, and of its ticks."""

    def __init__(self, client: "CameraClient", passed: Callable[[float], None]) -> None:
        """passed: called with the time that the fish has swum [s]"""
        self.frames: list[Frame] = []
        self.ticks: list[Tick] = []
        self._client = client
        self._on_progress = passed

    def tick(self, tick: Tick) -> None:
        """Add a tick, and the frames that have come since the last one."""
        self.ticks.append(tick)
        self.frames += self._client.poll()
        self._on_progress(tick.time - self.ticks[0].time)

    def event(self, event: Event) -> None:
        """Ignore an event."""


@contextmanager
def open_session(fish: Fish, seconds: float) -> Iterator["LiveSession"]:
    """Yield a session with the fish of a running fishd, which rests afterwards; print a notice."""
    from fishd.lab.session import LiveSession

    with ExitStack() as stack:
        stack.enter_context(raise_on_first_signal())
        rig = stack.enter_context(LiveSession(fish, *verb_lease()))
        echo(f"fishctl: it swims for {seconds:g} s; Ctrl-C stops it", err=True)
        yield rig


def find_fishd(endpoint: str | None, stack: ExitStack) -> Fish | None:
    """Return the running fishd, until `stack` is closed; None if none runs and none was named."""
    fish = stack.enter_context(Fish(endpoint))
    try:
        fish.status()
    except NoDaemon:
        if endpoint:
            raise
        return None
    return fish


@contextmanager
def follow_commands(endpoint: str | None, boot_id: str, watch: "TailWatch") -> Iterator[None]:
    """Add the instruction angles of fishd to `watch`, in a thread.

    boot_id: identifier of the boot from which the camera's clock counts; a fishd with another clock
        is left out, and so is one that does not answer
    """

    def follow(stopping: threading.Event) -> None:
        with suppress(FishError), Fish(endpoint) as fish:
            if fish.status().boot_id != boot_id:
                return
            for tick in fish.ticks():
                if stopping.is_set():
                    return
                watch.add_command(tick.time, tick.phi_c)

    with _in_thread(follow):
        yield


@contextmanager
def watch_tail(address: str | None, endpoint: str | None) -> Iterator["TailWatch"]:
    """Yield the fin angles of a camera, which a thread reads; raises `CameraLost` without one.

    endpoint: control socket of the fishd with the instruction angles
    """
    from fishd.camera.client import CameraClient
    from fishd.camera.tail_watch import TailWatch

    watch = TailWatch()
    with CameraClient(address, tail=True) as client:

        def follow(stopping: threading.Event) -> None:
            while not stopping.is_set():
                try:
                    client.poll(0.1)
                    client.check()
                except FishError:
                    watch.latest = None
                for tail in client.take_tails():
                    watch.add(tail)

        with _in_thread(follow), follow_commands(endpoint, client.state.boot_id, watch):
            yield watch


@contextmanager
def _in_thread(work: Callable[[threading.Event], None]) -> Iterator[None]:
    """Run a function in a thread; its argument is set when it has to end."""
    stopping = threading.Event()
    thread = threading.Thread(target=work, args=(stopping,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        stopping.set()
        thread.join(THREAD_TIMEOUT_S)


def refuse_lockstep(virtual: bool) -> None:
    """Raise `FishdError` for a fishd in lockstep, whose time only advances with an agent."""
    if virtual:
        raise FishdError(
            "this fishd is in lockstep: its fish swims only while an agent steps it; run it "
            "with lockstep: false"
        )
