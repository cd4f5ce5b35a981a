"""Cost of the force sampler: CPU, pairs per tick, and lateness of the ticks beside it.

Two real fishd run side by side, so that a noisy machine disturbs both equally: one with a simulated
fish and no sampler, one on a virtual Pi, which runs in a separate process.
"""

import statistics
import subprocess
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from common.daemon import Fishd, virtual_pi_settings
from common.machine import load, priorities, scheduling, stress
from common.processes import BIN
from common.report import Options, Report, progress, quantile, table
from fishd.core.signals import Tick

DOCUMENT = "reference/reliability.md"
HEAD = (
    "load | scheduler | lateness without sampler, p50 / p99 [µs] | with sampler | ratio of p99 | "
    "pairs per tick, least / median | sampler [% of a core] | write, p50 / p99 [µs]"
)


@contextmanager
def virtual_pi() -> Iterator[list[str]]:
    """Start a virtual Pi in a separate process, and yield the settings of a fishd for it."""
    with tempfile.TemporaryDirectory(prefix="fishd-") as folder:
        address = Path(folder) / "pi"
        settings = [f"virtual_pi.socket={address}", "virtual_pi.pigpio_port=0"]
        command = [str(BIN / "fishctl"), "virtual-pi", "run"]
        command += [word for setting in settings for word in ("--set", setting)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout
            port = int(process.stdout.readline().partition("127.0.0.1:")[2].split()[0])
            yield [
                *virtual_pi_settings(address, port),
                "servo.timeout=0.1",  # a stall of the machine must not end the round
            ]
        finally:
            process.terminate()
            process.wait(10)


def late(ticks: list[Tick]) -> tuple[float, float]:
    """Return median and 99th percentile of the lateness [µs]."""
    lateness = [tick.lateness_us for tick in ticks]
    return quantile(lateness, 0.5), quantile(lateness, 0.99)


def run_round(stressed: bool, priority: int, seconds: float) -> list[str]:
    """Run both for `seconds`, and return a row of the table."""
    setting = f"realtime.priority={priority}"
    with (
        virtual_pi() as settings,
        Fishd(setting) as without,
        Fishd(setting, *settings) as sampling,
        stress(stressed, seconds + 10.0),
    ):
        for each in (without, sampling):
            each.next_tick()
        time.sleep(2.0)
        without.waiting_ticks()
        sampling.waiting_ticks()
        before, begun = sampling.thread_seconds(), time.monotonic()
        time.sleep(seconds)
        elapsed = time.monotonic() - begun
        used = {
            thread: seconds_used - before.get(thread, 0.0)
            for thread, seconds_used in sampling.thread_seconds().items()
        }
        calm, ticks = late(without.waiting_ticks()), sampling.waiting_ticks()
        status = sampling.status()
        if status.mode != "running":
            raise SystemExit(f"the fish does not swim: {status.reason}")
    disturbed = late(ticks)
    pairs = [tick.samples for tick in ticks]
    sampler = max(share for thread, share in used.items() if thread != sampling.pid) / elapsed
    write = status.timing.phases["write"]
    return [
        load(stressed),
        scheduling(priority),
        f"{calm[0]:.0f} / {calm[1]:.0f}",
        f"{disturbed[0]:.0f} / {disturbed[1]:.0f}",
        f"{disturbed[1] / calm[1]:.2f}",
        f"{min(pairs)} / {statistics.median(pairs):.0f}",
        f"{100 * sampler:.0f}",
        f"{write.p50:.0f} / {write.p99:.0f}",
    ]


OPTIONS: Options = {
    "--seconds": {"type": float, "default": 60.0, "help": "per round (default: 60)"},
}


def measure(options: Namespace) -> Report:
    """Measure every load with every scheduler."""
    rows = []
    for priority in reversed(priorities()):
        for stressed in (False, True):
            rows.append(run_round(stressed, priority, options.seconds))
            progress(*rows[-1])
    return Report({"bench sampler": table(HEAD, rows)}, rows)
