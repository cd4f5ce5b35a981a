"""Who drives: one page at a time, which others may replace; a page that is gone stops the fish."""

import asyncio
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.processes import FISHCTL, Daemon, wait_until
from rigs.window_process import Browser, WindowProcess, open_page, running_window

from common.daemon import Fishd, virtual_pi
from fishd.client import Fish

GPIO = 18
"""Pin of the servo on a virtual Pi."""
HASTE = """
import signal
from fishd.window import live
signal.signal(signal.SIGUSR1, lambda *_: setattr(live, "DRIVER_TIMEOUT_S", 0.5))
"""
"""Code of a window that does not wait long for a page that is gone, from SIGUSR1 on."""
SINE = {"op": "set-controller", "args": {"name": "sine"}}


@pytest.fixture
def hasty_window(daemon: Daemon, tmp_path: Path) -> Iterator[WindowProcess]:
    """Yield a window that does not wait long for a page that is gone, once `hurry` is called."""
    with running_window(tmp_path, changes=HASTE, fish=daemon.endpoint) as process:
        yield process


def hurry(window: WindowProcess) -> None:
    """Let a `hasty_window` wait no longer; sooner, a slow start might count as an end."""
    window.process.send_signal(signal.SIGUSR1)


async def test_a_second_page_takes_over_and_the_first_one_sees_it(window: WindowProcess) -> None:
    async with (
        Browser(window.url) as browser,
        open_page(browser) as first,
        open_page(browser) as second,
    ):
        await first.swim()
        assert await second.refusal("drive") == (409, "driven")
        assert await second.refusal("request", SINE) == (409, "not-driver")
        await second.post("drive", {"take": True})
        driver = await first.until("driver", lambda driver: not driver["you_drive"])
        assert driver["client"] == second.hello["client"]
        assert await first.refusal("request", SINE) == (409, "not-driver")
        state = await second.request("set-controller", name="sine")
        assert (state["mode"], state["controller"]) == ("running", "sine")
        await first.request("stop")  # any page may stop
        await first.until_at_rest()


async def test_a_driver_that_returns_the_fish_lets_it_rest(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.swim()
        await page.post("release")
        await page.until_at_rest()
        assert await page.refusal("request", {"op": "clear-fault"}) == (409, "not-driver")


async def test_a_page_that_is_gone_stops_the_fish(hasty_window: WindowProcess) -> None:
    async with Browser(hasty_window.url) as browser, open_page(browser) as watcher:
        async with open_page(browser) as page:
            await page.swim()
        hurry(hasty_window)
        await watcher.until("driver", lambda driver: driver is None)
        await watcher.until_at_rest()


async def test_a_page_that_is_open_but_gives_no_sign_of_life_stops_the_fish(
    hasty_window: WindowProcess,
) -> None:
    async with Browser(hasty_window.url) as browser, open_page(browser) as page:
        await page.swim()
        hurry(hasty_window)
        await page.until("driver", lambda driver: driver is None)
        await page.until_at_rest()


async def test_a_fish_swims_on_without_its_page_if_the_driver_has_said_so(
    hasty_window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(hasty_window.url) as browser, open_page(browser) as watcher:
        async with open_page(browser) as page:
            await page.swim()
            await page.post("drive", {"keep": True})
        hurry(hasty_window)
        await watcher.until("driver", lambda driver: driver is None)
        for _ in range(20):
            ticks = await watcher.until("ticks")
        assert ticks[-1]["mode"] == "running"
    assert daemon.status().mode == "running"


async def test_a_page_whose_connection_was_interrupted_goes_on_driving(
    window: WindowProcess,
) -> None:
    async with Browser(window.url) as browser:
        async with open_page(browser) as page:
            await page.swim()
        async with open_page(browser, client=page.hello["client"]) as again:
            assert again.hello["client"] == page.hello["client"]
            assert again.hello["you_drive"]
            await again.request("stop")


async def test_no_other_device_continues_as_the_driver(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.swim()
        async with open_page(browser, client=page.hello["client"]) as twin:
            assert not twin.hello["you_drive"]  # the first one is open


async def test_a_window_that_is_killed_leaves_no_fish_swimming(
    new_window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(new_window.url) as browser, open_page(browser) as page:
        await page.swim()
        os.kill(new_window.pid, signal.SIGKILL)
    wait_until(lambda: daemon.status().mode == "idle")
    assert daemon.status().lease_expiry


async def test_a_fish_that_an_experiment_holds_is_taken_only_on_request(
    window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.drive()
        body = {"op": "set-controller", "args": {"name": "square"}}
        with_lease = await asyncio.create_subprocess_exec(
            *(daemon_measure(daemon)), stdout=asyncio.subprocess.DEVNULL
        )
        await page.until("event", lambda event: event["kind"] == "lease")
        assert await page.refusal("request", body) == (409, "leased")
        await page.post("request", body | {"take": True})
        assert await with_lease.wait() == 1


def daemon_measure(daemon: Daemon) -> list[str]:
    """Return the command of a measurement."""
    return [FISHCTL, "measure", "square", "--endpoint", daemon.endpoint, "--on", "live"]


@pytest.mark.realtime
async def test_an_emergency_stop_ends_the_pulses_within_a_fifth_of_a_second(tmp_path: Path) -> None:
    with (
        virtual_pi(tmp_path) as (pi, settings),
        Fishd(*settings) as fishd,
        running_window(tmp_path, fish=fishd.endpoint) as window,
        Fish(fishd.endpoint) as fish,
    ):

        def width() -> float:
            return pi.pigpiod.width(GPIO, time.monotonic())

        async def press() -> None:
            async with Browser(window.url) as browser:
                await browser.post("/api/fish/fish/estop")

        for _ in range(3):
            fish.clear_fault()
            fish.set_controller("square")
            wait_until(lambda: fish.status().mode == "running" and width() > 0.0)
            start = time.monotonic()
            await press()
            wait_until(lambda: not width())
            assert pi.pigpiod.history(GPIO)[-1][0] - start <= 0.2
