"""Memory and processor time of `fishd-window` with three open pages, and its emergency stop.

The stop is measured on a virtual Pi: from the press in the page to the last pulse of the servo.
"""

import asyncio
import json
import os
import tempfile
import time
from argparse import Namespace
from pathlib import Path
from typing import Any

import aiohttp
from msgspec import Struct

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
GPIO = 18


class Figures(Struct):
    """Results."""

    megabytes: float
    """Resident memory with the pages open [MB]."""
    cpu: float
    """Fraction of one core."""
    stops: list[float]
    """Time from the press to the last change of the pulses [s]."""


OPTIONS: Options = {
    "--seconds": {"type": float, "default": 30.0, "help": "to watch; default 30"},
    "--stops": {"type": int, "default": STOPS, "help": f"emergency stops; default {STOPS}"},
}


def cpu_seconds(pid: int) -> float:
    """Return the processor time of a process [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


async def watch(window: Window, seconds: float) -> tuple[float, float]:
    """Return memory [MB] and fraction of a core while three pages read ticks."""
    async with aiohttp.ClientSession(f"http://127.0.0.1:{window.port}") as session:

        async def read() -> None:
            async with session.ws_connect("/live", max_msg_size=0) as sock:
                async for _ in sock:
                    pass

        readers = [asyncio.create_task(read()) for _ in range(VIEWERS)]
        await asyncio.sleep(2.0)
        start, before = time.monotonic(), cpu_seconds(window.pid)
        await asyncio.sleep(seconds)
        cpu = (cpu_seconds(window.pid) - before) / (time.monotonic() - start)
        size = memory(window.pid)
        for reader in readers:
            reader.cancel()
        await asyncio.gather(*readers, return_exceptions=True)
    return size, cpu


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
    """Watch for half a minute, and stop the fish many times."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with Fishd() as fishd, Window(fishd.endpoint, name) as window:
            fishd.next_tick(TIMEOUT_S)
            size, cpu = asyncio.run(watch(window, options.seconds))
        figures = Figures(size, cpu, measure_stops(options.stops, folder))
    middle, highest = quantile(figures.stops, 0.5), max(figures.stops)
    rows = [
        [f"memory with {VIEWERS} pages", f"{figures.megabytes:.0f} MB", f"{MAX_MEGABYTES:.0f} MB"],
        [
            f"processor with {VIEWERS} pages",
            f"{100 * cpu:.1f} % of a core",
            f"{100 * MAX_CPU:.0f} %",
        ],
        ["emergency stop, median", f"{1e3 * middle:.0f} ms", ""],
        ["emergency stop, highest", f"{1e3 * highest:.0f} ms", f"{1e3 * MAX_STOP_S:.0f} ms"],
    ]
    processor, cores = list(machine().values())[:2]
    words = f"{len(figures.stops)} stops; {cores} cores of an {processor}."
    broken = size > MAX_MEGABYTES or cpu > MAX_CPU or highest > MAX_STOP_S
    text = f"{table('the window | measured | at most', rows)}\n\n{words}"
    return Report({"bench window": text}, figures, broken=broken)
