"""Comparison of two checkouts of fishd in turns, for `tick --against`.

It uses only the public interface of both: the programs fishd and fishctl, READY=1, and the fields
`lateness_us` and `busy_time_us` of a tick. The checkouts may differ in everything else.
"""

import json
import resource
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from common.daemon import TIMEOUT_S, Fishd
from common.machine import priorities, scheduling
from common.report import Report, progress, quantile, table

SETTLE = 2.0
"""Time that a fishd ticks before it is measured [s]."""
VIRTUAL_SECONDS = 300.0
Turn = dict[str, float]
"""Results of one checkout in one turn: quantities with their units, larger is worse for each."""


def compare(checkout: Path, seconds: float, rounds: int) -> Report:
    """Measure both in turns, each first in every other round.

    checkout: the other checkout, with its virtual environment in .venv, or that environment
    seconds: time that a fishd ticks in a turn [s]
    """
    other = next((b for b in (checkout / ".venv/bin", checkout / "bin") if b.is_dir()), None)
    if other is None:
        raise SystemExit(f"{checkout}: no virtual environment here: no .venv/bin and no bin")
    sides = [other.absolute(), Path(sys.executable).parent]
    for side in sides:
        take_turn(side, 1.0)  # warm up: files that are compiled or read from disk only once
    turns: list[tuple[Turn, Turn]] = []
    for number in range(rounds):
        order = sides if number % 2 else sides[::-1]
        turn_by_side = {side: take_turn(side, seconds) for side in order}
        turns.append((turn_by_side[sides[0]], turn_by_side[sides[1]]))
        progress(f"round {number + 1} of {rounds}", *_row("lateness p99 [µs]", turns)[:4])
    head = "quantity | before | after | after / before | 95 % interval | worse"
    text = (
        f"Before: {sides[0].parent}. After: {sides[1].parent}. Medians of {rounds} rounds in "
        f"turns; {seconds:g} s of 50 ms ticks each, {scheduling(priorities()[-1])} scheduling; "
        f"interval of the median ratio by bootstrap over rounds.\n\n"
        f"{table(head, [_row(quantity, turns) for quantity in turns[0][0]])}"
    )
    return Report({"bench tick against": text}, turns)


def take_turn(bin_folder: Path, seconds: float) -> Turn:
    """Measure a fishd that ticks at rest, then a swim in virtual time."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ready:
        ready.bind("")  # the kernel assigns an abstract name, which ends with the socket
        ready.settimeout(TIMEOUT_S)
        name = ready.getsockname().decode().replace("\0", "@")
        command = (str(bin_folder / "fishd"), "--no-print-status")
        priority = f"realtime.priority={priorities()[-1]}"
        begun = time.monotonic()
        with Fishd(priority, command=command, environment={"NOTIFY_SOCKET": name}) as fishd:
            while b"READY=1" not in ready.recv(4096):
                pass
            start_up, start_up_cpu = time.monotonic() - begun, fishd.cpu_seconds()
            time.sleep(SETTLE)
            fishd.waiting_messages()
            cpu = fishd.cpu_seconds()
            time.sleep(seconds)
            cpu = fishd.cpu_seconds() - cpu
            ticks = [json.loads(message) for message in fishd.waiting_messages()]
            memory, total = fishd.memory(), fishd.total_memory()
    virtual, virtual_cpu = virtual_time(bin_folder)
    lateness = [tick["lateness_us"] for tick in ticks]
    busy = [tick["busy_time_us"] for tick in ticks]  # until the record is sealed
    return {
        "lateness p50 [µs]": quantile(lateness, 0.5),
        "lateness p99 [µs]": quantile(lateness, 0.99),
        "busy time per tick, p50 [µs]": quantile(busy, 0.5),
        "busy time per tick, p99 [µs]": quantile(busy, 0.99),
        "CPU per tick, all processes [µs]": cpu / len(ticks) * 1e6,
        "RSS at rest [MB]": memory,
        "PSS at rest, with gateways [MB]": total,
        "start-up until READY=1 [ms]": start_up * 1e3,
        "start-up, processor time [ms]": start_up_cpu * 1e3,
        "virtual time, per tick [µs]": virtual,
        f"{VIRTUAL_SECONDS:g} s of virtual time, processor time [ms]": virtual_cpu * 1e3,
    }


def virtual_time(bin_folder: Path) -> tuple[float, float]:
    """Return the time of a tick in virtual time [µs], and the processor time of the run [s]."""
    command = [str(bin_folder / "fishctl"), "simulate", "swing", "--json"]
    command += ["--seconds", str(VIRTUAL_SECONDS)]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    report = subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return 0.05e6 / float(json.loads(report)["real_time_factor"]), cpu


def interval(ratios: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % confidence interval of the median of ratios."""
    draw = np.random.default_rng(0)
    medians = np.median(draw.choice(ratios, (10_000, len(ratios))), axis=1)
    low, high = np.percentile(medians, (2.5, 97.5))
    return float(low), float(high)


def _row(quantity: str, turns: list[tuple[Turn, Turn]]) -> list[str]:
    before, after = ([turn[quantity] for turn in side] for side in zip(*turns, strict=True))
    ratios = [new / old for old, new in zip(before, after, strict=True)]
    low, high = interval(ratios)
    return [
        quantity,
        *(f"{statistics.median(side):.4g}" for side in (before, after)),
        f"{statistics.median(ratios):.3f}",
        f"{low:.3f} – {high:.3f}",
        "**yes**" if low > 1.0 else "no" if high < 1.0 else "not shown",
    ]
