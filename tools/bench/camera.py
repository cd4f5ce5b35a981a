"""Lateness of fishd beside a camera that measures the fin angle, and without a camera, in turns.

A simulated camera draws the fish, so its process computes more than that of a real one. One fishd
runs throughout; in each round it ticks without a camera, with one that measures nothing, and with
one that measures. The load of the machine changes all three alike: compare ratios. Their 95 %
intervals are a bootstrap over rounds.
"""

import statistics
import time
from argparse import Namespace
from contextlib import ExitStack, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from common.daemon import TIMEOUT_S, Fishd, read_size
from common.machine import priorities, scheduling
from common.processes import BIN, FISHCTL, Process, call, sets
from common.report import Options, Report, progress, quantile_of_rounds, quantile_ratio, table
from fishd.camera.messages import CameraState
from fishd.camera.requests import CameraLost, CameraRequests

OPTIONS: Options = {
    "--seconds": {"type": float, "default": 20.0, "help": "per round and camera; default 20"},
    "--rounds": {"type": int, "default": 10, "help": "default 10"},
    "--rate": {"type": float, "default": 60.0, "help": "pictures per second; default 60"},
}
NONE, IDLE, MEASURING = "no camera", "a camera that does not measure", "a camera that measures"
NICE = 5
"""Niceness of the camera, as in its service."""
SETTLE_S = 1.0
"""Time that a camera runs before lateness counts [s]."""


class Turn(NamedTuple):
    """Results beside one camera, or none, in one round."""

    lateness: list[float]
    """Lateness of each tick [µs]."""
    measured: float = 0.0
    """Measured pictures per second."""
    memory: float = 0.0
    """Largest resident memory of the camera [MB]."""


class Camera(Process):
    """Simulated fishd-camera above a fishd; as a context manager it has ended afterwards."""

    def __init__(self, fishd: Fishd, *settings: str) -> None:
        self.address = f"ipc://{fishd.folder}/requests"
        addresses = (
            f"publish.requests={self.address}",
            f"publish.frames=ipc://{fishd.folder}/frames",
        )
        source = f"simulated.fishd={fishd.endpoint}"
        command = [str(BIN / "fishd-camera"), *sets(*addresses, source, *settings)]
        super().__init__("nice", f"--adjustment={NICE}", *command)  # which becomes the command
        self._requests = CameraRequests(self.address, TIMEOUT_S)
        deadline = time.monotonic() + TIMEOUT_S
        while time.monotonic() < deadline:
            with suppress(CameraLost):
                if self.state().state == "streaming":
                    return
            time.sleep(0.1)
        raise SystemExit("fishd-camera shows no frames")

    def __exit__(self, *details: object) -> None:
        self._requests.close()
        self.end_or_kill(TIMEOUT_S)
        super().__exit__(*details)

    def state(self) -> CameraState:
        """Return its state."""
        return self._requests.status()

    def largest_memory(self) -> float:
        """Return the largest resident memory so far [MB]."""
        return read_size(Path(f"/proc/{self.pid}/status"), "VmHWM")


def measure(options: Namespace) -> Report:
    """Return the table, and the ratio beside a camera that measures, with the last scheduling."""
    rate = f"simulated.rate={options.rate}"
    figures, rows = {}, []
    with TemporaryDirectory() as folder:
        learned = f"tail.learned={folder}/tail.bin"
        with Fishd() as fishd, Camera(fishd, rate, learned) as camera:
            words = ("--endpoint", fishd.endpoint, "--camera", camera.address, "--learn")
            call(FISHCTL, "camera", "measure", *words, check=True)
            learning_memory = camera.largest_memory()
        for priority in priorities():
            turns: dict[str, list[Turn]] = {NONE: [], IDLE: [], MEASURING: []}
            with Fishd(f"realtime.priority={priority}") as fishd:
                fishd.next_tick()
                for number in range(options.rounds):
                    for which in list(turns)[:: 1 if number % 2 else -1]:
                        turns[which].append(
                            _take_turn(fishd, which, options.seconds, rate, learned)
                        )
                    progress(f"round {number + 1} of {options.rounds}", scheduling(priority))
            rows += [[scheduling(priority), *_row(which, turns)] for which in turns]
            figures[scheduling(priority)] = turns
    about = (
        f"{options.rounds} rounds of {options.seconds:g} s of 50 ms ticks; {options.rate:g} "
        f"pictures of 640 × 480 a second. A camera that learns takes {learning_memory:.0f} MB."
    )
    head = (
        "scheduling | beside | lateness p50/p99 [µs] | p99, relative | measured [1/s] | memory [MB]"
    )
    number = f"{rows[-1][3]} ×"
    text = f"{about}\n\n{table(head, rows)}"
    return Report({"bench camera": text}, figures, number=number)


def _take_turn(fishd: Fishd, which: str, seconds: float, *settings: str) -> Turn:
    with ExitStack() as stack:
        camera, before = None, 0
        if which != NONE:
            is_measuring = f"tail.measure={which == MEASURING}".lower()
            camera = stack.enter_context(Camera(fishd, *settings, is_measuring))
        time.sleep(SETTLE_S)
        if camera:
            before = camera.state().measured_pictures
        fishd.waiting_messages()
        time.sleep(seconds)
        lateness = [tick.lateness_us for tick in fishd.waiting_ticks()]
        if camera is None:
            return Turn(lateness)
        measured = (camera.state().measured_pictures - before) / seconds
        return Turn(lateness, measured, camera.largest_memory())


def _row(which: str, turns: dict[str, list[Turn]]) -> list[str]:
    late, without = ([turn.lateness for turn in turns[name]] for name in (which, NONE))
    low, high = (quantile_of_rounds(late, share) for share in (0.5, 0.99))
    return [
        which,
        f"{low:.0f}/{high:.0f}",
        "" if which == NONE else quantile_ratio(late, without),
        f"{statistics.mean(turn.measured for turn in turns[which]):.1f}",
        f"{max(turn.memory for turn in turns[which]):.0f}",
    ]
