"""Cost of the window: weight of its page, memory, processor time, lateness, emergency stop.

The pages are those of a Chromium without a screen. In each round fishd ticks without pages and with
three of them, in turns; the browser runs throughout. Compare ratios, as the load of the machine
changes both alike. The stop is measured on a virtual Pi, from the press to the last pulse, while a
run of 100 MB is downloaded and pictures are drawn.
"""

import json
import os
import re
import shutil
import sys
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple
from urllib.request import Request, urlopen

from playwright.sync_api import Browser, sync_playwright

from common.daemon import TIMEOUT_S, Fishd, read_size, virtual_pi
from common.processes import BIN, FISHCTL, Process, call
from common.report import Options, Report, progress, quantile, quantile_ratio, table
from fishd.client import Fish

PAGES = 3
SETTLE_S = 2.0
"""Time after pages are opened or closed before lateness counts [s]."""
RUN_BYTES = 100 * 2**20
GPIO = 18
OPTIONS: Options = {
    "--seconds": {
        "type": float,
        "default": 20.0,
        "help": "per round, with and without; default 20",
    },
    "--rounds": {"type": int, "default": 10, "help": "default 10"},
    "--stops": {"type": int, "default": 20, "help": "emergency stops; default 20"},
}
_LOAD = (
    "/api/runs/large.mcap/download/recording.mcap",
    "/api/runs/large.mcap/download/all.zip",
    "/api/results.png?run=small.mcap",
)
"""Requests that go on during the emergency stops."""
_PAINT = """() => performance.getEntriesByName("first-contentful-paint")[0]?.startTime ?? 0"""
_WEIGHT = """() => [performance.getEntriesByType("navigation")[0],
  ...performance.getEntriesByType("resource")].reduce((sum, each) => sum + each.transferSize, 0)"""
_REPEAT = """\
import sys, urllib.request
while True:
    with urllib.request.urlopen(sys.argv[1]) as response:
        while response.read(2**16):
            pass
"""
"""Program that reads an address again and again."""


class Figures(NamedTuple):
    """Results."""

    weight: float
    """Of a first visit, compressed [kB]."""
    paints: list[float]
    """First contentful paint of each visit [s]."""
    memory: float
    """Largest resident memory of fishd-window [MB]."""
    processor: list[float]
    """Processor time of fishd-window with three pages, in each round, relative to a core."""
    without: list[list[float]]
    """Lateness of each tick in each round without pages [µs]."""
    beside: list[list[float]]
    """The same with three pages [µs]."""
    stops: list[float]
    """From each press to the last pulse [s]."""


class Window(Process):
    """Real fishd-window of a fishd; as a context manager it has ended afterwards."""

    def __init__(self, fishd: Fishd, folder: Path) -> None:
        config = folder / "window.yaml"
        config.write_text(f"runs: {folder}/runs\n", encoding="utf-8")
        words = ("--config", str(config), "--state", str(folder / "window"))
        where = ("--listen", "127.0.0.1:0", "--fish", f"fish={fishd.endpoint}")
        super().__init__(str(BIN / "fishd-window"), *words, *where)
        assert self.process.stderr
        for line in self.process.stderr:
            if found := re.search(r"the fish is at (http://\S+)/", line):
                self.url = found[1]
                return
        raise SystemExit("fishd-window does not start")

    def __exit__(self, *details: object) -> None:
        self.end_or_kill(TIMEOUT_S)
        super().__exit__(*details)

    def post(self, path: str) -> Any:
        """Return the answer to a request, as a page sends it."""
        headers = {"Origin": self.url, "Content-Type": "application/json"}
        with urlopen(Request(self.url + path, b"{}", headers)) as response:
            return json.loads(response.read())

    def processor_time(self) -> float:
        """Return the processor time so far [s]."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(options: Namespace) -> Report:
    """Return the table, and its results."""
    with TemporaryDirectory() as name:
        figures = _watch(options, Path(name))._replace(stops=_stop(options.stops, Path(name)))
    ratio = quantile_ratio(figures.beside, figures.without)
    rows = [
        ["first visit, compressed", f"{figures.weight:.0f} kB", "150 kB"],
        ["first paint, median", f"{quantile(figures.paints, 0.5):.2f} s", "0.5 s"],
        [f"memory with {PAGES} pages", f"{figures.memory:.0f} MB", "80 MB"],
        [
            f"processor with {PAGES} pages, median",
            f"{quantile(figures.processor, 0.5):.1%} of a core",
            "5 %",
        ],
        [f"lateness p99 with {PAGES} pages, relative", ratio, "1.2"],
        ["emergency stop, median", f"{1e3 * quantile(figures.stops, 0.5):.0f} ms", ""],
        ["emergency stop, highest", f"{1e3 * max(figures.stops):.0f} ms", "200 ms"],
    ]
    about = (
        f"{options.rounds} rounds of {options.seconds:g} s of 50 ms ticks; {options.stops} stops "
        "while a run of 100 MB is downloaded and pictures are drawn."
    )
    text = f"{about}\n\n{table('the window | measured | at most', rows)}"
    return Report({"bench window": text}, figures._asdict())


def _watch(options: Namespace, folder: Path) -> Figures:
    with ExitStack() as stack:
        fishd = stack.enter_context(Fishd())
        window = stack.enter_context(Window(fishd, folder))
        playwright = stack.enter_context(sync_playwright())
        chromium = shutil.which("chromium") or shutil.which("chromium-browser")
        browser = playwright.chromium.launch(
            executable_path=chromium, args=["--no-sandbox", "--disable-gpu"]
        )
        stack.callback(browser.close)
        fishd.next_tick()
        figures = Figures(0.0, [], 0.0, [], [], [], [])
        for number in range(options.rounds):
            for has_pages in (False, True) if number % 2 else (True, False):
                if not has_pages:
                    figures.without.append(_read_lateness(fishd, options.seconds))
                    continue
                with _open_pages(browser, window) as (weight, paint):
                    before, begun = window.processor_time(), time.monotonic()
                    figures.beside.append(_read_lateness(fishd, options.seconds))
                    used = window.processor_time() - before
                figures.processor.append(used / (time.monotonic() - begun))
                figures.paints.append(paint)
                figures = figures._replace(weight=weight)
            progress(f"round {number + 1} of {options.rounds}")
        memory = read_size(Path(f"/proc/{window.pid}/status"), "VmHWM")
    return figures._replace(memory=memory)


def _read_lateness(fishd: Fishd, seconds: float) -> list[float]:
    time.sleep(SETTLE_S)
    fishd.waiting_messages()
    time.sleep(seconds)
    return [tick.lateness_us for tick in fishd.waiting_ticks()]


@contextmanager
def _open_pages(browser: Browser, window: Window) -> Iterator[tuple[float, float]]:
    """Open pages that show the fish live; yield weight [kB] and first paint [s] of the first."""
    with ExitStack() as stack:
        seen: list[tuple[float, float]] = []
        for _ in range(PAGES):
            page = browser.new_page()  # in a context of its own, with an empty cache
            stack.callback(page.context.close)
            page.goto(window.url)
            page.wait_for_selector("#connection.live", timeout=1e3 * TIMEOUT_S)
            seen.append((page.evaluate(_WEIGHT) / 1e3, page.evaluate(_PAINT) / 1e3))
        yield seen[0]


def _stop(number: int, folder: Path) -> list[float]:
    """Return the time from each press to the last pulse of a fish that swims [s]."""
    stops = []
    with ExitStack() as stack:
        pi, settings = stack.enter_context(virtual_pi(folder))
        fishd = stack.enter_context(Fishd(*settings))
        window = stack.enter_context(Window(fishd, folder))
        fish = stack.enter_context(Fish(fishd.endpoint))
        fishd.next_tick()
        _make_runs(fishd, folder / "runs")
        loads = [
            stack.enter_context(Process(sys.executable, "-c", _REPEAT, window.url + path))
            for path in _LOAD
        ]

        def width() -> float:
            return pi.pigpiod.width(GPIO, time.monotonic())

        for _ in range(number):
            fish.clear_fault()
            fish.set_controller("square")
            while fish.status().mode != "running" or not width():
                time.sleep(0.01)
            time.sleep(0.5)
            begun = time.monotonic()
            window.post("/api/fish/fish/estop")
            while width() and time.monotonic() < begun + TIMEOUT_S:
                time.sleep(0.005)
            stops.append(pi.pigpiod.history(GPIO)[-1][0] - begun)
        if not all(load.runs for load in loads):
            raise SystemExit("fishd-window refused a download or a picture during the stops")
    return stops


def _make_runs(fishd: Fishd, runs: Path) -> None:
    """Leave a run of 100 MB, and a short one."""
    runs.mkdir(exist_ok=True)
    words = ("--endpoint", fishd.endpoint, "--folder", str(runs), "--for", "3")
    for name in ("large", "small"):
        call(FISHCTL, "record", name, *words, check=True)
    with (runs / "large.mcap").open("ab") as recording:
        recording.write(os.urandom(RUN_BYTES))
