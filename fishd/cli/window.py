"""The verbs of the page for people at the tank: open it, and pair and revoke devices."""

import http.client
import os
import socket
import sys
import webbrowser
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

import click
from msgspec.structs import replace

from fishd.cli.options import json_option
from fishd.cli.output import echo, print_json
from fishd.core import text
from fishd.core.console import log_format_option
from fishd.core.errors import StartupError
from fishd.core.process.shutdown import exit_now
from fishd.window.main import load_options, serve, window_options
from fishd.window.settings import WindowSettings

if TYPE_CHECKING:
    from fishd.window.devices import Devices, Scope

SERVICE_STATE = Path("/var/lib/fishd-window")
"""State folder of the service `fishd-window`."""
ANSWER_TIMEOUT_S = 2.0
"""Longest wait for the answer of a page that runs already [s]."""


@click.group(invoke_without_command=True)
@click.pass_context
def window(ctx: click.Context) -> None:
    """Show the fish on a web page for people at the tank, and control it there.

    Without a command, opens the page; if it does not run, starts it first. On this machine the page
    needs no pairing; other devices do.
    """
    if ctx.invoked_subcommand is None:
        ctx.exit(ctx.invoke(open_page))


def _load_running(**values: Any) -> WindowSettings:
    """Return the settings of the window that runs, unless the options name another one."""
    from fishd.window.register import find_running

    settings = load_options(**values)
    if values["path"] or values["listen"]:
        return settings
    for folder in (settings.state_folder, *(() if values["state"] else (SERVICE_STATE,))):
        for entry in find_running(folder):
            return replace(
                settings, listen=entry.listen, names=entry.names, state=os.fspath(folder)
            )
    return settings


@window.command("open")
@window_options
def open_page(place: str = "", **values: Any) -> int:
    """Open the page in a browser; start it unless it runs."""
    settings = _load_running(**values)
    url = _local_url(settings)
    if not _answers(url):
        exit_now(serve(settings, when_up=lambda url: _show(f"{url}{place}")))
    _show(f"{url}{place}")
    return 0


@window.command()
@window_options
@log_format_option
def start(log_format: str, **values: Any) -> None:
    """Serve the page until Ctrl-C, as fishd-window does."""
    exit_now(serve(load_options(**values), log_format))


@window.command(hidden=True)
@json_option
def forms(as_json: bool) -> None:
    """List the forms of the page's experiments."""
    from fishd.cli.forms import describe_forms

    described = describe_forms()
    if as_json:
        print_json(described)
    for form in () if as_json else described:
        echo(f"{form.title}: {form.about}")


@window.command()
@window_options
@click.option(
    "--scope",
    type=click.Choice(["watch", "drive"]),
    default="drive",
    show_default=True,
    help="What the device may do. Either may stop the fish in an emergency.",
)
@click.option(
    "--url",
    metavar="URL",
    help="Address by which the device reaches the page, such as that of a reverse proxy. [default: "
    "from the settings]",
)
@json_option
def pair(scope: "Scope", url: str | None, as_json: bool, **values: Any) -> None:
    """Print a link and a QR code that pair a device with the page.

    It pairs one device, within ten minutes. The QR code is drawn in a terminal only.
    """
    from fishd.window.devices import INVITATION_S

    settings = _load_running(**values)
    base = url or _network_url(settings)
    if urlsplit(base).scheme not in ("http", "https"):
        raise click.BadParameter("http://HOST:PORT/ or https://HOST/ is needed", param_hint="--url")
    token = _open_devices(settings).invite(scope)
    link = f"{base.rstrip('/')}/#pair={token}"
    if as_json:
        print_json({"url": link, "scope": scope, "seconds": INVITATION_S})
        return
    if sys.stdout.isatty():
        import segno

        segno.make(link, micro=False).terminal(compact=True)
    echo(f"open this on one device within {INVITATION_S / 60:.0f} minutes, to {scope}: {link}")


@window.command()
@window_options
@click.argument("name")
@json_option
def token(name: str, as_json: bool, **values: Any) -> None:
    """Print a token with which a program reads /metrics.

    A program on another computer, such as Prometheus, sends it as `Authorization: Bearer TOKEN`. It
    is a paired device of this NAME, which may only watch: `fishctl window revoke` ends its access.
    """
    devices = _open_devices(_load_running(**values))
    device, secret = devices.pair(devices.invite("watch"), name)
    if as_json:
        print_json({"name": device.name, "token": secret})
    else:
        echo(secret)


@window.command()
@window_options
@json_option
def devices(as_json: bool, **values: Any) -> None:
    """List the paired devices."""
    paired = _open_devices(_load_running(**values)).all()
    if as_json:
        keys = ("id", "name", "scope", "paired", "seen")
        print_json([{key: getattr(device, key) for key in keys} for device in paired])
    elif not paired:
        echo("no device is paired; pair one with 'fishctl window pair'")
    for device in () if as_json else paired:
        seen = datetime.fromtimestamp(device.seen)
        echo(f"{device.id}  {device.scope:<5}  seen {seen:%Y-%m-%d %H h}  {text.line(device.name)}")


@window.command()
@window_options
@click.argument("device")
@json_option
def revoke(device: str, as_json: bool, **values: Any) -> None:
    """Remove a device, and end what it does.

    Its pages are closed, and its jobs stop. The fish comes to rest, also where it would keep
    swimming without the page. DEVICE is its name or id, as `fishctl window devices` shows it.
    """
    removed = _open_devices(_load_running(**values)).revoke(device)
    if as_json:
        print_json({"id": removed.id, "name": removed.name})
    else:
        echo(f"{text.line(removed.name)} is no longer paired; what it drives and its jobs end")


def _open_devices(settings: WindowSettings) -> "Devices":
    from fishd.window.devices import Devices

    return Devices(settings.state_folder)


def _local_url(settings: WindowSettings) -> str:
    """Return the address of the page for a browser of this machine."""
    host, port = settings.address
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


def _network_url(settings: WindowSettings) -> str:
    """Return the address of the page for another device; raise `StartupError`."""
    host, port = settings.address
    if settings.is_local:
        if settings.names:
            return f"https://{settings.names[0]}/"
        raise StartupError(
            f"the page listens at {settings.listen}, which no other device reaches: start it with "
            "--listen 0.0.0.0:8880, or name the address of a reverse proxy with --url"
        )
    if host in ("0.0.0.0", "::"):
        host = _own_address(socket.AF_INET6 if ":" in host else socket.AF_INET)
    return f"http://{f'[{host}]' if ':' in host else host}:{port}/"


def _own_address(family: int) -> str:
    """Return the address of this machine in its network; its name if it has no network."""
    target = "2001:db8::1" if family == socket.AF_INET6 else "192.0.2.1"
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((target, 9))  # sends nothing, but chooses the address
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])


def _answers(url: str) -> bool:
    """Return whether a window answers there."""
    place = urlsplit(url)
    connection = http.client.HTTPConnection(place.netloc, timeout=ANSWER_TIMEOUT_S)
    try:
        connection.request("GET", "/api/session")
        return b'"loopback"' in connection.getresponse().read(10_000)
    except (OSError, http.client.HTTPException):
        return False
    finally:
        connection.close()


def _show(url: str) -> None:
    """Print the address, and open a browser on a desktop."""
    echo(f"the fish is at {url}")
    if os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or sys.platform == "darwin":
        webbrowser.open(url)
