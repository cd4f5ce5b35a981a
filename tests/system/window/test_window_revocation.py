"""Revocation of a device ends all that it does: its pages, its driving, its experiments."""

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from rigs.processes import Daemon, install, running, wait_until
from rigs.window_process import (
    NETWORK_HOST,
    Browser,
    Page,
    WindowProcess,
    open_page,
    running_window,
)

HASTE = """
import signal
from fishd.window import live
signal.signal(signal.SIGUSR1, lambda *_: setattr(live, "DRIVER_TIMEOUT_S", 0.0))
"""
"""Code of a window for which, from SIGUSR1 on, a page has left."""
SLOW_DISK = """
import signal, threading
from fishd.window import jobs
real, goes_on = jobs.list_words, threading.Event()
def list_words(*arguments):
    print("waiting for the disk", flush=True)
    goes_on.wait()
    return real(*arguments)
jobs.list_words = list_words
signal.signal(signal.SIGUSR1, lambda *_: goes_on.set())
"""
"""Code of a window whose jobs wait for a disk until SIGUSR1."""
WAITING = '''
"""A controller that loads until a file is there."""

import time
from pathlib import Path

from fishd.controllers.hold import Hold


class Waiting(Hold):
    """Loads until a file is there, and no longer than fishd waits for it."""

    def __init__(self, parameters, limits):
        super().__init__(parameters, limits)
        go_on, deadline = Path(__file__).with_name("go_on"), time.monotonic() + 9.0
        while not go_on.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
'''


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of packages, in which a controller that loads slowly is installed."""
    folder = tmp_path_factory.mktemp("packages") / "site"
    install(folder, {"patient": WAITING}, waiting="patient:Waiting")
    return folder


@pytest.fixture(scope="module")
def shared_daemon(site: Path) -> Iterator[Daemon]:
    """Run a daemon on a machine with these packages."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(site), prepend=os.pathsep)
        with running(site.parent) as daemon:
            yield daemon


@asynccontextmanager
async def paired(window: WindowProcess, name: str) -> AsyncIterator[Browser]:
    """Yield the browser of a device in the network that is paired to drive."""
    async with Browser(window.url, NETWORK_HOST) as browser:
        token = window.invite().rpartition("=")[2]
        await browser.post("/api/pair", {"token": token, "name": name})
        yield browser


async def revoke_by_command(window: WindowProcess, browser: Browser, name: str) -> None:
    """Revoke a device with `fishctl window revoke`."""
    ended = f"{name} is no longer paired; what it drives and its jobs end\n"
    assert window.ask("revoke", name) == ended


async def unpair_itself(window: WindowProcess, browser: Browser, name: str) -> None:
    """Let a device end its pairing, as its page can."""
    await browser.post("/api/unpair")


WAYS: list[Callable[[WindowProcess, Browser, str], Awaitable[None]]] = [
    revoke_by_command,
    unpair_itself,
]


def start_job(page: Page, kind: str, **options: Any) -> Awaitable[Any]:
    """Start a job."""
    return page.post("/api/jobs", {"fish": "fish", "kind": kind, "options": options})


@pytest.mark.parametrize("revoke", WAYS)
async def test_a_fish_that_keeps_swimming_for_a_revoked_device_comes_to_rest(
    new_window: WindowProcess, daemon: Daemon, revoke: Any
) -> None:
    async with paired(new_window, "stolen") as browser, open_page(browser) as page:
        await page.swim()
        await page.post("drive", {"keep": True})
        await revoke(new_window, browser, "stolen")
        await asyncio.to_thread(wait_until, lambda: daemon.status().mode == "idle")
        assert daemon.status().lease is None
        while not page.sock.closed:
            await page.sock.receive()


async def test_a_fish_that_swims_on_after_its_page_has_left_rests_once_the_device_is_revoked(
    daemon: Daemon, tmp_path: Path
) -> None:
    with running_window(tmp_path, changes=HASTE, fish=daemon.endpoint) as window:
        async with (
            Browser(window.url) as here,
            open_page(here) as watcher,
            paired(window, "left") as browser,
            open_page(browser) as page,
        ):
            await page.swim()
            await page.post("drive", {"keep": True})
            await page.sock.close()
            window.process.send_signal(signal.SIGUSR1)
            await watcher.until("driver", lambda driver: driver is None)
            for _ in range(20):
                ticks = await watcher.until("ticks")
            assert ticks[-1]["mode"] == "running"
            await revoke_by_command(window, browser, "left")
            await watcher.until_at_rest()
        assert daemon.status().lease is None


async def test_a_revoked_device_does_not_stop_a_fish_that_another_one_drives_since(
    new_window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(new_window.url) as here, open_page(here) as other:
        async with paired(new_window, "former") as browser, open_page(browser) as page:
            await page.swim()
            await other.drive()
            await revoke_by_command(new_window, browser, "former")
            while not page.sock.closed:
                await page.sock.receive()
        later = daemon.status().seq + 20
        ticks = await other.until("ticks", lambda ticks: ticks[-1]["seq"] > later)
        assert ticks[-1]["mode"] == "running"


async def test_the_experiments_of_a_revoked_device_end_and_those_of_others_go_on(
    new_window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(new_window.url) as here, open_page(here) as watcher:
        mine = await start_job(watcher, "record", name="mine")
        async with paired(new_window, "stolen") as browser, open_page(browser) as page:
            await page.drive()
            recording = await start_job(page, "record", name="theirs")
            measurement = await start_job(page, "measure", controller="square", seconds=60)
            await watcher.until("status", lambda status: status["lease"])
            await watcher.until("ticks", lambda ticks: ticks[-1]["mode"] == "running")
            await revoke_by_command(new_window, browser, "stolen")
            states: dict[str, Any] = {}
            while len(states) < 2:
                job = await watcher.until("job", lambda job: job["state"] != "running")
                assert "stopped: the device that started it was revoked" in job["lines"]
                states[job["id"]] = job["state"]
        assert states == {recording["id"]: "stopped", measurement["id"]: "stopped"}
        (going,) = [job for job in await here.get("/api/jobs") if job["state"] == "running"]
        assert going["id"] == mine["id"]
        (ended,) = [j for j in await here.get("/api/jobs") if j["id"] == measurement["id"]]
        assert ended["resumable"]
    assert (daemon.status().mode, daemon.status().lease) == ("idle", None)


async def test_a_revoked_device_whose_controller_still_loads_stops_at_once_and_does_not_start_again(
    new_window: WindowProcess, daemon: Daemon, site: Path
) -> None:
    (site / "go_on").unlink(missing_ok=True)
    waiting = {"op": "set-controller", "args": {"name": "waiting"}}
    square = {"op": "set-controller", "args": {"name": "square"}}

    async with paired(new_window, "slow") as browser, open_page(browser) as page:
        await page.swim()
        loading = asyncio.create_task(page.refusal("request", waiting))
        queued = [asyncio.create_task(page.refusal("request", square)) for _ in range(3)]
        await page.until("ticks")
        await revoke_by_command(new_window, browser, "slow")
        await asyncio.to_thread(wait_until, lambda: daemon.status().mode == "idle")
        assert not loading.done()
        (site / "go_on").touch()
        assert await loading in ((409, "superseded"), (409, "no-lease"), (409, "not-driver"))
        assert {await refusal for refusal in queued} == {(409, "not-driver")}
    assert (daemon.status().mode, daemon.status().lease) == ("idle", None)


async def test_a_job_that_waited_for_the_disk_does_not_start_once_its_device_is_revoked_or_replaced(
    daemon: Daemon, tmp_path: Path
) -> None:
    with running_window(tmp_path, changes=SLOW_DISK, fish=daemon.endpoint) as window:
        stdout = window.process.stdout
        assert stdout

        async with (
            Browser(window.url) as here,
            open_page(here) as page,
            open_page(here) as other,
            paired(window, "stolen") as browser,
            open_page(browser) as theirs,
        ):
            body: dict[str, Any] = {"fish": "fish", "kind": "record"}
            revoked = asyncio.create_task(theirs.refusal("/api/jobs", body))
            assert await asyncio.to_thread(stdout.readline)
            await page.drive()
            body = {"fish": "fish", "kind": "measure", "options": {"controller": "square"}}
            replaced = asyncio.create_task(page.refusal("/api/jobs", body))
            await revoke_by_command(window, browser, "stolen")
            while not theirs.sock.closed:
                await theirs.sock.receive()
            await asyncio.sleep(0.2)
            await other.drive()
            window.process.send_signal(signal.SIGUSR1)
            assert await revoked == (401, "not-paired")
            assert await replaced == (409, "not-driver")
            assert await here.get("/api/jobs") == []
