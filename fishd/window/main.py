"""Command `fishd-window`, which serves a page of the fish until a signal ends it."""

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from fishd import __version__
from fishd.core import text
from fishd.core.console import complain, run
from fishd.core.errors import FishdError, install_command
from fishd.core.process.interruption import on_signal
from fishd.core.process.logs import UNHURRIED_FLUSH_TIMEOUT_S, LogWriter
from fishd.core.process.shutdown import exit_now
from fishd.core.process.systemd_notify import SystemdNotifier
from fishd.window.settings import DEFAULT_LISTEN, WindowSettings, load

log = logging.getLogger(__name__)
NAME = "fishd-window"
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


@click.command(NAME, context_settings={"help_option_names": ["-h", "--help"]})
@window_options
@click.option(
    "--log-format",
    type=click.Choice(["text", "json"]),
    default="text",
    show_default=True,
    help="How logs on standard error look.",
)
@click.version_option(__version__, prog_name=NAME)
def window(
    path: Path | None,
    listen: str | None,
    fish: dict[str, str],
    state: str | None,
    log_format: str,
) -> int:
    """Serve a page of the fish for people at the tank, until SIGINT (Ctrl-C), SIGTERM or SIGHUP.

    Exit status: 0 after a clean stop, 1 when something failed, 2 for a wrong option, 78 when the
    settings are wrong.
    """
    return serve(load(path, listen=listen, fish=fish, state=state), log_format)


def serve(
    settings: WindowSettings,
    log_format: str = "text",
    when_up: Callable[[str], None] = lambda url: None,
) -> int:
    """Serve the page until a signal; return the exit status.

    when_up: is called with the address of the page
    """
    try:
        from fishd.window.api import Window
    except ImportError as error:
        complain(
            NAME, f"{text.error_message(error)}; install it with: {install_command('window')}", 1
        )
    logs = LogWriter(log_format)

    async def run_window() -> None:
        loop, ended = asyncio.get_running_loop(), asyncio.Event()
        notifier = SystemdNotifier()
        with on_signal(lambda: loop.call_soon_threadsafe(ended.set)):
            async with Window(settings) as server:
                log.info("the fish is at %s", server.url)
                when_up(server.url)
                while not ended.is_set():
                    notifier.ticked(loop.time())
                    try:
                        async with asyncio.timeout(1.0):
                            await ended.wait()
                    except TimeoutError:
                        continue
                notifier.stopping()

    try:
        asyncio.run(run_window())
    except FishdError as error:
        log.critical("%s", error)
        return 1
    except Exception:
        log.critical("fishd-window failed", exc_info=True)
        return 1
    finally:
        logs.close(UNHURRIED_FLUSH_TIMEOUT_S)
    return 0


def main() -> None:
    """Run the command `fishd-window`."""
    exit_now(run(window, NAME))
