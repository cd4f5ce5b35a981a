"""Command `fishd-window`, which serves a page of the fish until a signal ends it."""

import asyncio
import gc
import logging
import sys
import threading
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, TypeVar

import click

from fishd import __version__
from fishd.core import text
from fishd.core.console import complain, log_format_option, run
from fishd.core.errors import install_command
from fishd.core.process.service import run_service
from fishd.core.process.shutdown import exit_now
from fishd.core.process.systemd_notify import SystemdNotifier
from fishd.window.settings import DEFAULT_LISTEN, UNNAMED_FISH, WindowSettings, load

log = logging.getLogger(__name__)
NAME = "fishd-window"
NOTIFY_PERIOD_S = 0.2
"""Time between two looks for a signal, with a notification of systemd [s]."""
GARBAGE_THRESHOLDS = 700, 5, 3
"""Thresholds of the garbage collector. Ended connections are cycles of much memory; with the
default 700, 10, 10 they are kept for long, and collecting them then takes the window longer."""
SWITCH_INTERVAL_S = 5e-4
"""Time after which a thread, such as that of an emergency stop, gets the interpreter [s]."""
F = TypeVar("F", bound=Callable[..., Any])


def _parse_fish(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> dict[str, str]:
    fish = {}
    for value in values:
        name, equals, endpoint = value.partition("=")
        if not equals:
            raise click.BadParameter(f"'{value}' is not valid: NAME=ENDPOINT is needed")
        fish[name] = endpoint
    return fish


def window_options(function: F) -> F:
    """Add the options of the window."""
    options = [
        click.option(
            "--config",
            "path",
            type=click.Path(path_type=Path, readable=False),
            help="YAML file with the keys listen, fish, names, origins, runs and state.",
        ),
        click.option(
            "--listen",
            metavar="HOST:PORT",
            help="Address of the page; 0.0.0.0:8880 for the network, where devices need pairing. "
            f"[default: {DEFAULT_LISTEN}]",
        ),
        click.option(
            "--fish",
            metavar="NAME=ENDPOINT",
            multiple=True,
            callback=_parse_fish,
            help="Name and control socket of a fish. Repeatable. [default: that of this machine]",
        ),
        click.option(
            "--state",
            type=click.Path(),
            help="Folder of the paired devices. [default: ~/.local/state/fishd-window]",
        ),
    ]
    for option in reversed(options):
        function = option(function)
    return function


def load_options(
    *, path: Path | None, listen: str | None, fish: dict[str, str], state: str | None
) -> WindowSettings:
    """Return the settings that these options name; `fishctl --endpoint` names the fish, too."""
    endpoint = click.get_current_context().find_root().obj
    if endpoint and not fish:
        fish = {UNNAMED_FISH: endpoint}
    return load(path, listen=listen, fish=fish, state=state)


@click.command(NAME, context_settings={"help_option_names": ["-h", "--help"]})
@window_options
@log_format_option
@click.version_option(__version__, prog_name=NAME)
def window(log_format: str, **values: Any) -> int:
    """Serve a page of the fish for people at the tank, until SIGINT (Ctrl-C), SIGTERM or SIGHUP.

    Exit status: 0 after a clean stop, 1 when something failed, 2 for a wrong option, 78 when the
    settings are wrong.
    """
    return serve(load_options(**values), log_format)


def serve(
    settings: WindowSettings,
    log_format: str = "text",
    when_up: Callable[[str], None] = lambda url: None,
) -> int:
    """Serve the page until a signal; return the exit status.

    when_up: is called with the address of the page
    """
    try:
        from fishd.window.window_server import WindowServer
    except ImportError as error:
        complain(
            NAME, f"{text.error_message(error)}; install it with: {install_command('window')}", 1
        )

    async def run_window(stopping: threading.Event) -> None:
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        gc.freeze()
        gc.set_threshold(*GARBAGE_THRESHOLDS)
        notifier = SystemdNotifier()
        async with WindowServer(settings) as server:
            log.info("the fish is at %s", server.url)
            when_up(server.url)
            while not stopping.is_set():
                notifier.ticked(time.monotonic())
                await asyncio.sleep(NOTIFY_PERIOD_S)  # a thread may have to wait for a disk
            notifier.stopping()

    return run_service(NAME, log_format, lambda stopping: _run_to_end(run_window(stopping)))


def _run_to_end(window: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine, without a wait for threads at its end: their disks may stall."""
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)
    loop.run_until_complete(window)


def main() -> None:
    """Run the command `fishd-window`."""
    exit_now(run(window, NAME))
