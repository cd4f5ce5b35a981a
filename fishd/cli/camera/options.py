"""What the verbs about a camera share: which camera, where a picture goes, and who swims."""

import os
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import yaml

from fishd.cli.options import verb_lease
from fishd.cli.output import echo
from fishd.client import Fish
from fishd.core.errors import FishdError, NoDaemon
from fishd.core.process.interruption import interrupted_once
from fishd.core.signals import Event, Tick

if TYPE_CHECKING:
    from fishd.camera.client import CameraClient
    from fishd.core.camera_frames import Frame
    from fishd.lab.session import LiveSession

camera_option = click.option(
    "--camera",
    "address",
    metavar="ADDRESS",
    help="Where the camera takes requests; default: $FISHD_CAMERA, else the one of this machine.",
)
png_option = click.option(
    "--plot",
    "png",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write the picture into this file.",
)


def check_png(path: Path | None) -> None:
    """Refuse a picture that cannot be written, before anything moves or is looked at."""
    if path is None:
        return
    refused, folder = f"'{path}' is not valid for --plot: ", path.parent
    if path.suffix.lower() != ".png":
        raise click.UsageError(f"{refused}a name ending in .png is needed")
    if not folder.is_dir():
        raise click.UsageError(f"{refused}there is no folder {folder}")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise click.UsageError(f"{refused}nothing may be written into the folder {folder}")


def yaml_of(settings: dict[str, Any]) -> str:
    """Lines to be pasted into a file of settings; the keys of their sections have dots."""
    data: dict[str, Any] = {}
    for key, value in settings.items():
        *sections, name = key.split(".")
        inner = data
        for section in sections:
            inner = inner.setdefault(section, {})
        inner[name] = value
    return yaml.safe_dump(data, sort_keys=False).rstrip()


class Watcher:
    """Collects the frames that come while a fish swims, and its ticks."""

    def __init__(self, client: "CameraClient", passed: Callable[[float], None]) -> None:
        """passed: gets how long it has swum so far [s]"""
        self.frames: list[Frame] = []
        self.ticks: list[Tick] = []
        self._client = client
        self._passed = passed

    def tick(self, tick: Tick) -> None:
        """Take what has come meanwhile."""
        self.ticks.append(tick)
        self.frames += self._client.poll()
        self._passed(tick.time - self.ticks[0].time)

    def event(self, event: Event) -> None:
        """Nothing is needed of it."""


@contextmanager
def rig_of(fish: Fish, seconds: float) -> Iterator["LiveSession"]:
    """The fish of a running fishd, at rest again afterwards; says that it swims."""
    from fishd.lab.session import LiveSession

    with ExitStack() as stack:
        stack.enter_context(interrupted_once())
        rig = stack.enter_context(LiveSession(fish, *verb_lease()))
        echo(f"fishctl: it swims for {seconds:g} s; Ctrl-C stops it", err=True)
        yield rig


def fish_of(endpoint: str | None, stack: ExitStack) -> Fish | None:
    """The fishd that runs, until `stack` is closed; None if none runs and none was named."""
    fish = stack.enter_context(Fish(endpoint))
    try:
        fish.status()
    except NoDaemon:
        if endpoint:
            raise
        return None
    return fish


def refuse_lockstep(virtual: bool) -> None:
    """Raise `FishdError` where time stands still unless an agent lets it pass."""
    if virtual:
        raise FishdError(
            "this fishd is in lockstep: its fish swims only while an agent lets it; let it run "
            "with lockstep: false"
        )
