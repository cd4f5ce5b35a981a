"""Measures what the force sampler costs: CPU, pairs per tick, and lateness of the ticks beside it.

    sudo .venv/bin/python tools/bench_sampler.py                            print the table
    sudo .venv/bin/python tools/bench_sampler.py --write docs/reliability.md    put it there

Two real fishd swim side by side, so that a noisy machine disturbs them alike: one with a simulated
fish and no sampler, one on a virtual Pi, which runs in a process of its own.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bench_contestants import Fishd, quantile
from bench_machine import PRIORITY, fifo_permitted, stress
from reports import put, table

from fishd.signals import Tick

FISHCTL = str(Path(sys.executable).with_name("fishctl"))
HEAD = [
    "load",
    "scheduler",
    "lateness without sampler, p50 / p99 [µs]",
    "with sampler",
    "ratio of p99",
    "pairs per tick, least / median",
    "sampler [% of a core]",
    "write, p50 / p99 [µs]",
]


@contextmanager
def virtual_pi() -> Iterator[list[str]]:
    """A virtual Pi in a process of its own; the overrides for a fishd that is to use it."""
    with tempfile.TemporaryDirectory(prefix="bench-pi-") as folder:
        socket = f"virtual_pi.socket={folder}/pi"
        command = [
            FISHCTL,
            "virtual-pi",
            "run",
            "--set",
            socket,
            "--set",
            "virtual_pi.pigpio_port=0",
        ]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            assert process.stdout
            port = process.stdout.readline().partition("127.0.0.1:")[2].split()[0]
            yield [
                "robot=virtual-pi",
                socket,
                f"servo.pigpio.port={port}",
                "servo.pigpio.timeout=0.1",  # a stall of the machine must not end the round
                f"state_folder={folder}",
            ]
        finally:
            process.terminate()
            process.wait(10)


def thread_seconds(pid: int) -> dict[int, float]:
    """CPU time of each thread of a process so far [s]."""
    found = {}
    for task in Path(f"/proc/{pid}/task").iterdir():
        fields = (task / "stat").read_text(encoding="ascii").rpartition(")")[2].split()
        found[int(task.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return found


def late(ticks: list[Tick]) -> tuple[float, float]:
    """Median and 99th percentile of the lateness [µs]."""
    lateness = [tick.lateness_us for tick in ticks]
    return quantile(lateness, 0.5), quantile(lateness, 0.99)


def run_round(stressed: bool, priority: int, seconds: float) -> list[str]:
    """Let both swim for `seconds`; a row of the table."""
    scheduling = f"realtime.priority={priority}"
    with (
        virtual_pi() as overrides,
        Fishd(scheduling) as without,
        Fishd(scheduling, *overrides) as sampling,
        stress(stressed, seconds + 10.0),
    ):
        for each in (without, sampling):
            each.next_tick()
        time.sleep(2.0)
        without.waiting_ticks()
        sampling.waiting_ticks()
        before, begun = thread_seconds(sampling.pid), time.monotonic()
        time.sleep(seconds)
        elapsed = time.monotonic() - begun
        used = {
            thread: seconds_used - before.get(thread, 0.0)
            for thread, seconds_used in thread_seconds(sampling.pid).items()
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
        "every core busy" if stressed else "none",
        f"SCHED_FIFO {priority}" if priority else "normal",
        f"{calm[0]:.0f} / {calm[1]:.0f}",
        f"{disturbed[0]:.0f} / {disturbed[1]:.0f}",
        f"{disturbed[1] / calm[1]:.2f}",
        f"{min(pairs)} / {statistics.median(pairs):.0f}",
        f"{100 * sampler:.0f}",
        f"{write.p50:.0f} / {write.p99:.0f}",
    ]


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="per round (default: 60)")
    parser.add_argument("--write", type=Path, metavar="FILE", help="put the table into FILE")
    options = parser.parse_args()
    rows = []
    for priority in (PRIORITY, 0) if fifo_permitted() else (0,):
        for stressed in (False, True):
            rows.append(run_round(stressed, priority, options.seconds))
            print(" | ".join(rows[-1]), flush=True)
    if options.write:
        put(options.write, "bench_sampler", table(HEAD, rows))


if __name__ == "__main__":
    main()
