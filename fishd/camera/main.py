"""Command `fishd-camera`, which publishes the frames of a camera until a signal ends it."""

import logging
import stat
import threading
from contextlib import suppress
from pathlib import Path

import click

from fishd import __version__
from fishd.camera.settings import CameraSettings, hide_secrets, load
from fishd.camera.sources.base import Source
from fishd.core import text
from fishd.core.console import complain, log_format_option, run
from fishd.core.errors import install_command
from fishd.core.process.service import run_service
from fishd.core.process.shutdown import exit_now

log = logging.getLogger(__name__)
NAME = "fishd-camera"


def open_source(settings: CameraSettings) -> Source:
    """Return the source that the settings name; it does not open the camera yet."""
    if settings.source == "v4l2":
        from fishd.camera.sources.v4l2 import V4l2Source

        return V4l2Source(settings.v4l2)
    if settings.source == "stream":
        from fishd.camera.sources.stream import StreamSource

        return StreamSource(settings.stream)
    from fishd.camera.sources.simulated import SimulatedSource

    return SimulatedSource(settings.simulated, settings.picture.size)


@click.command(NAME, context_settings={"help_option_names": ["-h", "--help"]})
@click.option(
    "--config",
    "path",
    type=click.Path(path_type=Path, readable=False),
    help="YAML file; without it, a simulated camera above the fish of this machine.",
)
@click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Override one key of the settings, such as source=v4l2. Repeatable.",
)
@log_format_option
@click.version_option(__version__, prog_name=NAME)
def camera(path: Path | None, overrides: tuple[str, ...], log_format: str) -> int:
    """Publish the frames of a camera above the tail until SIGINT (Ctrl-C), SIGTERM or SIGHUP.

    Exit status: 0 after a clean stop, 1 when something failed, 2 for a wrong option, 78 when the
    settings are wrong.
    """
    settings = load(path, overrides)
    try:
        from fishd.camera.measuring import learned_path
        from fishd.camera.server import Server

        source = open_source(settings)
    except ImportError as error:
        complain(
            NAME, f"{text.error_message(error)}; install it with: {install_command('camera')}", 1
        )

    def serve(stopping: threading.Event) -> None:
        logging.getLogger("linuxpy").setLevel(logging.WARNING)
        if path is not None:
            warn_of_readers(path, settings)
        with Server(settings, source, learned_path(settings, path)) as server:
            server.run(stopping.is_set)

    return run_service(NAME, log_format, serve)


def warn_of_readers(path: Path, settings: CameraSettings) -> None:
    """Log a warning where every user of this machine can read the password of a camera."""
    url = settings.stream.url
    if url is None or hide_secrets(url) == url:
        return
    with suppress(OSError):
        if path.stat().st_mode & stat.S_IROTH:
            log.warning(
                "%s holds a password, and every user of this machine can read it: run "
                "chmod 640 %s, and chgrp fishd %s where fishd-camera is a service",
                *(path,) * 3,
            )


def main() -> None:
    """Run the command `fishd-camera`."""
    exit_now(run(camera, NAME))
