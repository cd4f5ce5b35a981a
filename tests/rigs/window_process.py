"""Running `fishd-window`, and pages that are open in it: real HTTP and WebSocket clients."""

import asyncio
import contextlib
import os
import re
import sys
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

import aiohttp
import msgspec

from rigs import preloaded
from rigs.processes import FISHD, PATIENCE, Process, fishctl

NETWORK_HOST = "fish.example"
"""Name by which devices of the network reach a window."""
FISHD_WINDOW: tuple[str, ...] = (f"{FISHD}-window",)
"""Command that starts a window."""
if not os.environ.get("JUDGES_REAL_TIME"):
    FISHD_WINDOW = (*preloaded.UNHURRIED_COMMAND, "fishd-window")


class WindowProcess(Process):
    """Running `fishd-window`."""

    def __init__(
        self, folder: Path, *arguments: str, changes: str = "", settings: str = "", **fish: str
    ) -> None:
        """
        folder: for paired devices, runs, and the camera above the first fish
        changes: Python code that runs first, such as a shorter timeout
        settings: further lines of its settings
        fish: control sockets by the name of the fish
        """
        self.state = folder / "window"
        config = folder / "window.yaml"
        camera = f"cameras: {{{next(iter(fish))}: ipc://{folder}/camera-requests}}" if fish else ""
        config.write_text(f"runs: {folder}/runs\nnames: [{NETWORK_HOST}]\n{camera}\n{settings}\n")
        options = ("--config", str(config), "--state", str(self.state), "--listen", "127.0.0.1:0")
        pairs = [word for name, where in fish.items() for word in ("--fish", f"{name}={where}")]
        code = f"{changes}\nfrom fishd.__main__ import fishd_window; fishd_window()"
        start = (sys.executable, "-P", "-c", code) if changes else FISHD_WINDOW
        super().__init__(*start, *options, *pairs, *arguments)

    def wait_until_up(self) -> Self:
        assert self.process.stderr
        self.log, match = "", None
        while not match:
            line = self.process.stderr.readline()
            self.log += line
            assert line, self.log
            match = re.search(r"the fish is at (http://\S+)/", line)
        self.url = match[1]
        return self

    @property
    def port(self) -> int:
        """Port of the page."""
        return urlsplit(self.url).port or 0

    def ask(self, verb: str, *words: str) -> str:
        """Return what a verb of `fishctl window` about its devices prints."""
        done = fishctl("window", verb, "--state", str(self.state), *words)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout

    def invite(self, scope: str = "drive") -> str:
        """Return a link that pairs a device of the network."""
        url = f"{self.url.replace('127.0.0.1', NETWORK_HOST)}/"
        link = msgspec.json.decode(self.ask("pair", "--scope", scope, "--url", url, "--json"))[
            "url"
        ]
        assert re.fullmatch(rf"http://{NETWORK_HOST}:\d+/#pair=[\w-]{{22}}", link)
        return str(link)


@contextlib.contextmanager
def running_window(folder: Path, *arguments: str, **options: str) -> Iterator[WindowProcess]:
    """Run a `fishd-window` that always ends with the context."""
    with WindowProcess(folder, *arguments, **options) as process:
        try:
            yield process.wait_until_up()
        finally:
            print(f"fishd-window said:\n{process.log}{process.end()[2]}")


class Browser:
    """Client that sends what a browser sends: host, origin, cookies."""

    def __init__(self, url: str, host: str | None = None) -> None:
        """host: name by which it reaches the window; by default its address"""
        place = urlsplit(url)
        authority = f"{host}:{place.port}" if host else place.netloc
        headers = {"Host": authority, "Origin": f"http://{authority}"}
        self.session = aiohttp.ClientSession(
            url, headers=headers, cookie_jar=aiohttp.CookieJar(unsafe=True)
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.session.close()

    async def get(self, path: str, **options: Any) -> Any:
        """Return the result of a request."""
        async with self.session.get(path, **options) as response:
            return _result(await response.read())

    async def post(self, path: str, body: Any = None, **options: Any) -> Any:
        """Return the result of a request."""
        async with self.session.post(path, json=body or {}, **options) as response:
            return _result(await response.read())

    async def refusal(self, path: str, body: Any = None, **options: Any) -> tuple[int, str]:
        """Return status and code of a request that is refused."""
        method = "GET" if body is None else "POST"
        async with self.session.request(method, path, json=body, **options) as response:
            answer = msgspec.json.decode(await response.read())
            assert not answer["ok"]
            assert answer["error"]["message"]
            return response.status, answer["error"]["code"]


def _result(payload: bytes) -> Any:
    answer = msgspec.json.decode(payload)
    assert answer["ok"], answer
    return answer["result"]


class Page:
    """A page that is open in a browser."""

    def __init__(self, browser: Browser, fish: str, sock: aiohttp.ClientWebSocketResponse) -> None:
        self.browser, self.fish, self.sock = browser, fish, sock
        self.hello: dict[str, Any] = {}

    async def message(self) -> tuple[str, Any]:
        """Return the next message."""
        kind, payload = msgspec.json.decode(await self.sock.receive_str())
        return kind, payload

    async def until(self, kind: str, true: Callable[[Any], bool] = lambda _: True) -> Any:
        """Return the first message of a kind for which a condition holds."""
        while True:
            other, payload = await self.message()
            if other == kind and true(payload):
                return payload

    async def post(self, what: str, body: Any = None) -> Any:
        """Return the result of a request about the fish of this page."""
        path = what if what.startswith("/") else f"/api/fish/{self.fish}/{what}"
        return await self.browser.post(path, body, headers=self._headers)

    async def refusal(self, what: str, body: Any = None) -> tuple[int, str]:
        """Return status and code of a request that is refused."""
        path = what if what.startswith("/") else f"/api/fish/{self.fish}/{what}"
        return await self.browser.refusal(path, body or {}, headers=self._headers)

    async def request(self, op: str, **arguments: Any) -> Any:
        """Return the result of a request to the fish."""
        return await self.post("request", {"op": op, "args": arguments})

    async def drive(self) -> None:
        """Take the role of the driver, from the page of an earlier test, too."""
        await self.post("drive", {"take": True})

    async def swim(self, controller: str = "square") -> None:
        """Drive, start a controller, and wait until it swims."""
        await self.drive()
        await self.request("set-controller", name=controller)
        await self.until("ticks", lambda ticks: ticks[-1]["mode"] == "running")

    async def until_at_rest(self) -> None:
        """Wait until the fish rests."""
        await self.until("ticks", lambda ticks: ticks[-1]["mode"] == "idle")

    @property
    def _headers(self) -> dict[str, str]:
        return {"X-Client": self.hello["client"]}


@contextlib.asynccontextmanager
async def open_page(browser: Browser, fish: str = "fish", client: str = "") -> AsyncIterator[Page]:
    """Open a page, and read its first message."""
    path = f"/live?fish={fish}&client={client}"
    async with browser.session.ws_connect(path, max_msg_size=0) as sock:
        page = Page(browser, fish, sock)
        kind, page.hello = await page.message()
        assert kind == "hello"
        yield page


async def wait_until_live(window: WindowProcess) -> None:
    """Wait until a window hears its fish."""
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.until("ticks")


def run_apart(task: Coroutine[Any, Any, None]) -> None:
    """Run a task in another thread, as the loop of playwright may run in this one."""
    with ThreadPoolExecutor(1) as thread:
        thread.submit(asyncio.run, _end_in_time(task)).result()


async def _end_in_time(task: Coroutine[Any, Any, None]) -> None:
    async with asyncio.timeout(PATIENCE):
        await task
