"""A fishd that hangs, is killed or restarts: pages are told, and get all ticks of the next one."""

import os
import signal
from pathlib import Path

import pytest
from rigs.processes import Daemon, running
from rigs.window_process import Browser, WindowProcess, open_page, running_window

from fishd.window.fish_link import FishLink

NO_ANSWER_ONCE = """
from fishd.client import AsyncFish, NoDaemon
list_controllers = AsyncFish.controllers
async def fail(fish):
    AsyncFish.controllers = list_controllers
    raise NoDaemon("no answer")
AsyncFish.controllers = fail
"""
"""Code of a window whose first request for the controllers is not answered."""


async def test_a_fishd_that_hangs_is_stale_then_lost_then_live(
    own_daemon: Daemon, own_window: WindowProcess
) -> None:
    async with Browser(own_window.url) as browser, open_page(browser) as page:
        await page.until("ticks")
        own_daemon.stop()
        try:
            stale = await page.until("connection", lambda c: c["state"] == "stale")
            assert stale["age"] > 0.0
            assert "no tick for" in stale["message"]
            lost = await page.until("connection", lambda c: c["state"] == "lost")
            assert "it hangs, is stopped or is overloaded" in lost["message"]
        finally:
            os.kill(own_daemon.pid, signal.SIGCONT)
        await page.until("connection", lambda c: c["state"] == "live")
        await page.until("ticks")


async def test_a_status_that_another_one_has_overtaken_is_not_taken_for_a_restart(
    daemon: Daemon,
) -> None:
    kinds: list[str] = []
    link = FishLink("fish", daemon.endpoint, lambda kind, _: kinds.append(kind))
    first, second = daemon.status(), daemon.status()
    assert first.uptime < second.uptime
    for status in (second, first):
        await link._take_status(status)
    await link.close()
    assert link.status == second
    assert kinds == ["hello", "status"]


async def test_a_fishd_that_is_killed_is_lost_and_its_successor_is_announced(
    tmp_path: Path,
) -> None:
    with running(tmp_path) as first, running_window(tmp_path, fish=first.endpoint) as window:
        async with Browser(window.url) as browser, open_page(browser) as page:
            await page.until("ticks", lambda ticks: ticks[-1]["seq"] > 5)
            first.kill()
            await page.until("connection", lambda c: c["state"] == "lost")
            refused = await page.refusal("request", {"op": "stop"})
            assert refused == (503, "no-daemon")
            with running(tmp_path):
                told = await page.until("connection", lambda c: c["state"] == "restarted")
                assert "fishd has restarted: it is process" in told["message"]
                await page.until("hello")
                kind, payload = await page.message()
                while kind not in ("history", "ticks"):
                    kind, payload = await page.message()
                assert kind == "ticks" or payload["seq"] == sorted(payload["seq"])
                await page.until("connection", lambda c: c["state"] == "live")


async def test_a_window_shows_several_fish_by_name_and_waits_for_one_that_is_off(
    own_daemon: Daemon, tmp_path: Path
) -> None:
    other = f"ipc://{tmp_path}/none"
    with running_window(tmp_path, tuna=own_daemon.endpoint, bream=other) as window:
        async with Browser(window.url) as browser:
            async with open_page(browser, "tuna") as page:
                assert page.hello["fish"] == ["tuna", "bream"]
                await page.until("ticks")
            async with open_page(browser, "bream") as page:
                lost = await page.until("connection", lambda c: c["state"] == "lost")
                assert "no process listens there" in lost["message"]
                assert page.hello["status"] is None
            states = {fish["name"]: fish["state"] for fish in await browser.get("/api/fish")}
            assert states == {"tuna": "live", "bream": "lost"}


async def test_a_fishd_that_does_not_list_its_controllers_at_once_is_asked_again(
    own_daemon: Daemon, tmp_path: Path
) -> None:
    with running_window(tmp_path, changes=NO_ANSWER_ONCE, fish=own_daemon.endpoint) as window:
        async with Browser(window.url) as browser, open_page(browser) as page:
            while not page.hello["controllers"]:
                page.hello = await page.until("hello")


@pytest.mark.realtime
async def test_a_page_is_told_within_a_second_that_ticks_have_ended(
    own_daemon: Daemon, own_window: WindowProcess
) -> None:
    async with Browser(own_window.url) as browser, open_page(browser) as page:
        await page.until("ticks")
        os.kill(own_daemon.pid, signal.SIGKILL)
        told = await page.until("connection", lambda c: c["state"] in ("stale", "lost"))
        assert told["age"] < 1.0
