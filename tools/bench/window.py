"""Memory and processor time of `fishd-window` with three open pages, and its emergency stop.

The pages are those of a Chromium without a screen. The lateness of fishd's ticks is measured
without and with them, in turn, in the same run: without, the browser runs and shows no page.
The stop is measured on a virtual Pi: from the press in the page to the last pulse of the servo.
"""

import asyncio
import json
import os
import shutil
import tempfile
import time
from argparse import Namespace
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
from msgspec import Struct
from playwright.async_api import Browser, async_playwright

from common.daemon import TIMEOUT_S, Fishd, virtual_pi
from common.machine import machine
from common.report import Options, Report, quantile, table
from fishd.client import Fish
from reliability.window import Window, memory

VIEWERS = 3
STOPS = 20
MAX_MEGABYTES = 60.0
MAX_CPU = 0.05
MAX_STOP_S = 0.2
MAX_LATENESS_CHANGE = 0.2
"""Largest relative change of the 99th percentile of the lateness by the pages."""
PAUSE_S = 2.0
"""Time after pages are opened or closed before lateness is measured [s]."""
BLOCKS = 5
"""Number of times that lateness is measured without, and with pages."""
GPIO = 18


class Figures(Struct):
    """Results."""

    megabytes: float
    """Resident memory with the pages open [MB]."""
    cpu: float
    """Fraction of one core."""
    lateness_without: float
    """99th percentile of the lateness of ticks without pages [µs]."""
    lateness_with: float
    """99th percentile of the lateness of ticks with the pages open [µs]."""
    load: float
    """Load average of the machine in the minute before."""
    stops: list[float]
    """Time from the press to the last change of the pulses [s]."""


OPTIONS: Options = {
    "--seconds": {
        "type": float,
        "default": 305.0,
        "help": "to watch without, and as long with pages; default 305, for 6100 ticks each",
    },
    "--stops": {"type": int, "default": STOPS, "help": f"emergency stops; default {STOPS}"},
}


def cpu_seconds(pid: int) -> float:
    """Return the processor time of a process [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Watched(Struct):
    """Measurements while pages were open and closed in turn."""

    megabytes: float
    cpu: float
    lateness_without: list[float]
    """Lateness of each tick [µs]."""
    lateness_with: list[float]


@asynccontextmanager
async def open_pages(browser: Browser, window: Window) -> AsyncIterator[None]:
    """Open pages that show the fish live, within the context."""
    async with AsyncExitStack() as stack:
        for _ in range(VIEWERS):
            page = await browser.new_page()
            stack.push_async_callback(page.close)
            await page.goto(f"http://127.0.0.1:{window.port}/")
            await page.wait_for_selector("#connection.live", timeout=3e3 * TIMEOUT_S)
        yield


async def watch(window: Window, fishd: Fishd, seconds: float) -> Watched:
    """Return memory, processor time and lateness; seconds: without, and as long with pages [s]."""
    part = seconds / BLOCKS
    without, with_pages = list[float](), list[float]()
    cpu = 0.0

    async def read_lateness() -> list[float]:
        await asyncio.sleep(PAUSE_S)
        fishd.waiting_ticks()
        await asyncio.sleep(part)
        return [tick.lateness_us for tick in fishd.waiting_ticks()]

    async with async_playwright() as playwright:
        chromium = shutil.which("chromium") or shutil.which("chromium-browser")
        arguments = ["--no-sandbox", "--disable-gpu"]
        browser = await playwright.chromium.launch(executable_path=chromium, args=arguments)
        for _ in range(BLOCKS):
            without += await read_lateness()
            async with open_pages(browser, window):
                start, before = time.monotonic(), cpu_seconds(window.pid)
                with_pages += await read_lateness()
                cpu += (cpu_seconds(window.pid) - before) / (time.monotonic() - start) / BLOCKS
                size = memory(window.pid)
        await browser.close()
    return Watched(size, cpu, without, with_pages)


def press(window: Window) -> Any:
    """Press the emergency stop, as the page does; return the answer."""
    url = f"http://127.0.0.1:{window.port}"

    async def post() -> Any:
        async with (
            aiohttp.ClientSession(url, headers={"Origin": url}) as session,
            session.post("/api/fish/fish/estop", json={}) as response,
        ):
            return json.loads(await response.read())

    return asyncio.run(post())


def measure_stops(number: int, folder: Path) -> list[float]:
    """Return the time from each press to the last pulse of a fish that swims [s]."""
    stops = []
    with (
        virtual_pi(folder) as (pi, settings),
        Fishd(*settings) as fishd,
        Window(fishd.endpoint, str(folder)) as window,
        Fish(fishd.endpoint) as fish,
    ):

        def width() -> float:
            return pi.pigpiod.width(GPIO, time.monotonic())

        fishd.next_tick(TIMEOUT_S)
        for _ in range(number):
            fish.clear_fault()
            fish.set_controller("square")
            while fish.status().mode != "running" or not width():
                time.sleep(0.01)
            time.sleep(0.5)
            start = time.monotonic()
            press(window)
            while width() and time.monotonic() < start + TIMEOUT_S:
                time.sleep(0.005)
            stops.append(pi.pigpiod.history(GPIO)[-1][0] - start)
    return stops


def measure(options: Namespace) -> Report:
    """Watch for ten minutes, and stop the fish many times; twelve minutes."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Fishd() as fishd, Window(fishd.endpoint, name) as window:
            fishd.next_tick(TIMEOUT_S)
            load = os.getloadavg()[0]
            watched = asyncio.run(watch(window, fishd, options.seconds))
        without, with_pages = (
            quantile(lateness, 0.99)
            for lateness in (watched.lateness_without, watched.lateness_with)
        )
        size, cpu = watched.megabytes, watched.cpu
        stops = measure_stops(options.stops, folder)
        figures = Figures(size, cpu, without, with_pages, load, stops)
    middle, highest = quantile(figures.stops, 0.5), max(figures.stops)
    rows = [
        [f"memory with {VIEWERS} pages", f"{figures.megabytes:.0f} MB", f"{MAX_MEGABYTES:.0f} MB"],
        [
            f"processor with {VIEWERS} pages",
            f"{100 * cpu:.1f} % of a core",
            f"{100 * MAX_CPU:.0f} %",
        ],
        ["lateness p99 without pages", f"{without:.0f} µs", ""],
        [
            f"lateness p99 with {VIEWERS} pages",
            f"{with_pages:.0f} µs ({with_pages / without - 1:+.0%})",
            f"±{MAX_LATENESS_CHANGE:.0%}",
        ],
        ["emergency stop, median", f"{1e3 * middle:.0f} ms", ""],
        ["emergency stop, highest", f"{1e3 * highest:.0f} ms", f"{1e3 * MAX_STOP_S:.0f} ms"],
    ]
    processor, cores = list(machine().values())[:2]
    ticks = len(watched.lateness_with)
    words = (
        f"{len(figures.stops)} stops; {ticks} ticks with pages, and as many without, in turn; load "
        f"average {load:.1f} at the start; {cores} cores of an {processor}."
    )
    is_changed = abs(with_pages / without - 1.0) > MAX_LATENESS_CHANGE
    broken = size > MAX_MEGABYTES or cpu > MAX_CPU or highest > MAX_STOP_S or is_changed
    text = f"{table('the window | measured | at most', rows)}\n\n{words}"
    return Report({"bench window": text}, figures, broken=broken)
