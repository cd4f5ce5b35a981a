"""The verb that serves a web page with the camera's picture."""

import asyncio
import threading
from contextlib import suppress

import click

from fishd.cli.camera.options import camera_option
from fishd.cli.options import json_option
from fishd.cli.output import echo, print_json_line
from fishd.core.errors import StartupError
from fishd.core.process.interruption import on_signal

DEFAULT_PORT = 9876
JOIN_TIMEOUT_S = 1.0
"""Longest wait for the thread of the camera at the end [s]."""


@click.command()
@camera_option
@click.option(
    "--port",
    type=click.IntRange(0, 65535),
    default=DEFAULT_PORT,
    show_default=True,
    help="Port of the page; 0: any.",
)
@click.option(
    "--host",
    default="127.0.0.1",
    show_default=True,
    metavar="ADDRESS",
    help="Address of the page. The default is for this machine only; with another one, every "
    "computer that reaches it can see the pictures.",
)
@json_option
def page(address: str | None, port: int, host: str, as_json: bool) -> None:
    """Show what the camera sees on a web page, live, with the axis of motion, until Ctrl-C.

    It needs nothing from the internet, and accepts no request that changes anything.
    """
    with suppress(KeyboardInterrupt):
        asyncio.run(_serve(address, host, port, as_json))


async def _serve(address: str | None, host: str, port: int, as_json: bool) -> None:
    from fishd.camera.page.feed import Feed, News
    from fishd.camera.page.server import PageServer

    loop, ended = asyncio.get_running_loop(), asyncio.Event()
    failures: list[BaseException] = []
    server = PageServer(host, port)

    def tell(news: News) -> None:
        with suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(server.show, news)

    feed = Feed(address, tell)

    def follow() -> None:
        try:
            feed.run()
        except BaseException as error:
            failures.append(error)
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(ended.set)

    thread = threading.Thread(target=follow, name="camera", daemon=True)
    try:
        async with server:
            with on_signal(lambda: loop.call_soon_threadsafe(ended.set)):
                thread.start()
                if as_json:
                    print_json_line({"url": server.url})
                else:
                    echo(f"the camera is at {server.url}; Ctrl-C ends it")
                await ended.wait()
            feed.stop()
            await asyncio.to_thread(thread.join, JOIN_TIMEOUT_S)
    except StartupError:
        feed.close()
        raise
    if failures:
        raise failures[0]
