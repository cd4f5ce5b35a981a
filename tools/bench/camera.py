"""Cost of a camera for fishd, age of frames at a learner, and speed of drawing.

In each round the same fishd swims twice: alone, and with a fishd-camera, a learner that takes its
frames and a page that takes its views. Which comes first alternates, so that a noisy machine
disturbs both alike. The age of a frame is the time from its publication, as the camera tells it,
until a learner in another process has it, over loopback TCP.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

from common.daemon import Fishd
from common.machine import machine_in_short
from common.processes import BIN
from common.report import Options, Report, progress, quantile, table
from fishd.camera.simulated import DEFAULT, WEB, SimulatedCameraSettings, TailPainter

DOCUMENT = "how-to/camera.md"
MAX_AGE_S = 10e-3
"""Goal for the age of a frame at a learner, p99 [s]."""
MAX_LATENESS_RATIO = 1.2
"""Goal for the lateness with camera, learner and page relative to that without, p99."""
MIN_FRAMES_PER_S = 10_000
"""Goal for the number of drawn frames per second."""
RATE = 60.0
"""Frame rate of the camera [1/s]."""
LEARNER = """
import json, sys, time
from fishd.camera.client import CameraClient

ages, begin = [], time.monotonic()
with CameraClient(sys.argv[1]) as client:
    print("ready", flush=True)
    for frame in client.frames():
        ages.append(time.monotonic() - frame.available)
        if time.monotonic() - begin > float(sys.argv[2]):
            break
print(json.dumps(ages))
"""
VIEWER = """
import sys
from fishd.camera.client import CameraClient

with CameraClient(sys.argv[1], views=True) as client:
    print("ready", flush=True)
    for view in client.views():
        pass
"""


class Round(NamedTuple):
    """Results of one fishd without and with a camera."""

    without: list[float]
    """Lateness of its ticks [s]."""
    with_camera: list[float]
    """Lateness of its ticks beside a camera, a learner and a page [s]."""
    ages: list[float]
    """Ages of frames at the learner [s]."""


@contextmanager
def process(*command: str, ready: bool = True) -> Iterator[subprocess.Popen[str]]:
    """Start a program, and yield it after its first line of output."""
    started = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        if ready:
            assert started.stdout
            started.stdout.readline()
        yield started
    finally:
        started.terminate()
        started.wait(10)


@contextmanager
def camera(fishd: Fishd) -> Iterator[str]:
    """Start a fishd-camera above the fish, and yield the address of its requests."""
    requests = f"ipc://{fishd.folder}/camera"
    pairs = {
        "simulated.fishd": fishd.endpoint,
        "simulated.rate": RATE,
        "publish.requests": requests,
        "publish.frames": "tcp://127.0.0.1:0",
    }
    words = [word for key, value in pairs.items() for word in ("--set", f"{key}={value}")]
    log = fishd.folder / "camera.log"
    with log.open("wb") as file:
        started = subprocess.Popen([str(BIN / "fishd-camera"), *words], stderr=file)
        try:
            deadline = time.monotonic() + 20.0
            while b"streaming" not in log.read_bytes():
                if started.poll() is not None or time.monotonic() > deadline:
                    raise SystemExit(f"the camera has no frames: {log.read_text()}")
                time.sleep(0.1)
            yield requests
        finally:
            started.terminate()
            started.wait(10)


def lateness(fishd: Fishd, seconds: float) -> list[float]:
    """Return the lateness of the ticks during `seconds` [s]."""
    time.sleep(1.0)
    fishd.waiting_ticks()
    time.sleep(seconds)
    return [tick.lateness_us * 1e-6 for tick in fishd.waiting_ticks()]


def beside_camera(fishd: Fishd, seconds: float) -> tuple[list[float], list[float]]:
    """Return the lateness beside a camera, a learner and a page, and the ages of frames [s]."""
    with (
        camera(fishd) as requests,
        process(sys.executable, "-c", VIEWER, requests),
        process(sys.executable, "-c", LEARNER, requests, str(seconds)) as learner,
    ):
        late = lateness(fishd, seconds)
        assert learner.stdout
        return late, json.loads(learner.stdout.readline())


def run_round(number: int, seconds: float) -> Round:
    """Run one round; the order alternates."""
    with Fishd() as fishd:
        fishd.next_tick()
        if number % 2:
            late, ages = beside_camera(fishd, seconds)
            return Round(lateness(fishd, seconds), late, ages)
        without = lateness(fishd, seconds)
        return Round(without, *beside_camera(fishd, seconds))


def drawn(settings: SimulatedCameraSettings) -> float:
    """Return the frames of 84 x 84 px drawn per second by one thread, best of five."""
    painter = TailPainter(settings, 84)
    rates = []
    for _ in range(5):
        begun = time.perf_counter()
        for number in range(2000):
            painter.paint(0.2, 1.0, 0.01 * number)
        rates.append(2000 / (time.perf_counter() - begun))
    return max(rates)


OPTIONS: Options = {
    "--seconds": {"type": float, "default": 20.0, "help": "of each part of a round (20)"},
    "--rounds": {"type": int, "default": 6, "help": "rounds, each first in turn (6)"},
}


def measure(options: Namespace) -> Report:
    """Return the three tables."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    rates = {"default": drawn(DEFAULT), "web": drawn(WEB)}
    rounds = []
    for number in range(options.rounds):
        rounds.append(run_round(number, options.seconds))
        without, beside = (quantile(each, 0.99) for each in rounds[-1][:2])
        progress(str(number + 1), f"p99 without {without * 1e6:.0f} µs, with {beside * 1e6:.0f} µs")
    without = [late for each in rounds for late in each.without]
    beside = [late for each in rounds for late in each.with_camera]
    ages = [age for each in rounds for age in each.ages]
    ratio = quantile(beside, 0.99) / quantile(without, 0.99)
    each = [quantile(one.with_camera, 0.99) / quantile(one.without, 0.99) for one in rounds]
    rows = [
        ["lateness of fishd alone, p50 / p99", _us(without), f"{len(without)} ticks", ""],
        ["beside camera, learner and page", _us(beside), f"{len(beside)} ticks", ""],
        [
            "p99 beside camera ÷ p99 alone",
            f"{ratio:.2f} (median of rounds {statistics.median(each):.2f})",
            f"≤ {MAX_LATENESS_RATIO:g}",
            _verdict(ratio <= MAX_LATENESS_RATIO),
        ],
        [
            "age of a frame at a learner, p50 / p99",
            " / ".join(f"{quantile(ages, share) * 1e3:.1f}" for share in (0.5, 0.99)) + " ms",
            f"p99 ≤ {MAX_AGE_S * 1e3:g} ms",
            _verdict(quantile(ages, 0.99) <= MAX_AGE_S),
        ],
        *(
            [f"frames drawn a second, rig {name}", f"{rate:.0f}", f"≥ {MIN_FRAMES_PER_S}",
             _verdict(rate >= MIN_FRAMES_PER_S)]
            for name, rate in rates.items()
        ),
    ]  # fmt: skip
    text = table("quantity | measured | goal | met", rows)
    about = f"{options.rounds} rounds of twice {options.seconds:g} s; {RATE:g} frames a second."
    figures = {"ratio": ratio, "rounds": each, "rates": rates, "ages": len(ages)}
    return Report({"bench camera": f"{text}\n\n{about} {machine_in_short()}"}, figures)


def _us(values: list[float]) -> str:
    return " / ".join(f"{quantile(values, share) * 1e6:.0f}" for share in (0.5, 0.99)) + " µs"


def _verdict(met: bool) -> str:
    return "yes" if met else "**no**"
