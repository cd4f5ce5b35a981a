"""Punctuality, speed and size of fishd, compared with cyclictest on the same busy machine.

Machines are noisy, so compare ratios: both run at the same time, under the same load.
Everything stays on this machine and stops by itself.

With --against, two checkouts of fishd are compared instead, in turns.
"""

import json
import statistics
import subprocess
import time
from argparse import Namespace
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import msgspec
from msgspec import Struct

from bench.compare import compare
from bench.cyclictest import Cyclictest, Lateness, lateness
from common.daemon import Fishd
from common.machine import load, machine, priorities, scheduling, stress
from common.processes import BIN
from common.report import Options, Report, progress, quantile, table
from fishd.core.signals import Percentiles, Timing

TICK = 0.05
"""Tick of the robot [s]."""
FAST = 0.002
"""Shortest tick of fishd [s]."""
FISHCTL = str(BIN / "fishctl")


class Figures(Struct, frozen=True):
    """Cost of one fishd in one round."""

    sealed: Percentiles
    """Time from the start of a tick until its record is sealed, for all ticks of the round [µs]."""
    timing: Timing
    """Timing in `fishctl status` at the end, including start-up."""
    cpu: float
    """Fraction of one core."""
    rss: float
    """Resident memory at the end [MB]."""


class Round(Struct, frozen=True):
    """Results of both at the same time; fishd is the first of `lateness`."""

    stressed: bool
    priority: int
    """SCHED_FIFO priority; 0 for the normal scheduler."""
    tick: float
    lateness: list[Lateness]
    fishd: Figures


class Latency(Struct, frozen=True):
    """Waiting times of a user, idle or under load: medians over several runs [s]."""

    stressed: bool
    first_tick: float
    """Time from the start of the process to the first tick."""
    status: float
    """Time of `fishctl status`, from the start of the process to its exit."""


class Results(Struct, frozen=True):
    """Results of one run."""

    machine: dict[str, str]
    seconds: float
    """Length of a round."""
    rounds: list[Round]
    latencies: list[Latency]
    real_time_factor: float
    """Real-time factor of `fishctl simulate` at 50 ms ticks."""


def run_round(stressed: bool, priority: int, tick: float, seconds: float) -> Round:
    """Run fishd and cyclictest for `seconds`."""
    with ExitStack() as stack:
        fishd = stack.enter_context(Fishd(f"tick={tick}", f"realtime.priority={priority}"))
        fishd.next_tick()
        time.sleep(1.0)
        other = Cyclictest(tick, seconds, priority)
        stack.callback(other.kill)
        fishd.waiting_ticks()
        start, cpu = time.monotonic(), fishd.cpu_seconds()
        time.sleep(seconds)
        cpu = (fishd.cpu_seconds() - cpu) / (time.monotonic() - start)
        ticks = fishd.waiting_ticks()
        busy = [message.busy_time_us for message in ticks]
        missed = ticks[-1].missed_slots - ticks[0].missed_slots
        itself = msgspec.structs.replace(
            lateness("fishd", tick, [message.lateness_us * 1e-6 for message in ticks]),
            missed=missed / (ticks[-1].seq - ticks[0].seq + missed),
        )
        figures = Figures(
            sealed=Percentiles(quantile(busy, 0.5), quantile(busy, 0.99), max(busy), 0),
            timing=fishd.status().timing,
            cpu=cpu,
            rss=fishd.memory(),
        )
        return Round(stressed, priority, tick, [itself, *other.results()], figures)


def measure_latency(stressed: bool, priority: int, runs: int) -> Latency:
    """Measure several starts of fishd, and several requests for its status."""
    first_ticks, statuses = [], []
    override = f"realtime.priority={priority}"
    for _ in range(runs):
        with Fishd(override) as fishd:
            tick = (
                fishd.next_tick()
            )  # the very first tick may have been published before the subscription
            before = (tick.seq - 1 + tick.missed_slots) * fishd.status().tick
            first_ticks.append(tick.time - before - fishd.started)
            for _ in range(3):
                began = time.monotonic()
                command = [FISHCTL, "status", "--endpoint", fishd.endpoint]
                subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
                statuses.append(time.monotonic() - began)
    return Latency(stressed, statistics.median(first_ticks), statistics.median(statuses))


def real_time_factor() -> float:
    """Return the real-time factor of a simulated fish, the better of two runs."""
    command = [FISHCTL, "simulate", "swing", "--seconds", "600", "--json"]
    reports = [subprocess.run(command, check=True, stdout=subprocess.PIPE) for _ in range(2)]
    return max(float(json.loads(report.stdout)["real_time_factor"]) for report in reports)


def measure_all(seconds: float, runs: int) -> Results:
    """Run the whole benchmark: idle, then under load."""
    factor = real_time_factor()
    best = priorities()[-1]
    rounds, latencies = [], []
    for stressed in (False, True):
        with stress(stressed, limit=4 * seconds + 30 * runs + 60):
            for tick, priority in (*((TICK, priority) for priority in priorities()), (FAST, best)):
                _show_progress(f"{seconds:g} s of {tick * 1e3:g} ms ticks", stressed, priority)
                rounds.append(run_round(stressed, priority, tick, seconds))
            _show_progress("start-up and fishctl status", stressed, best)
            latencies.append(measure_latency(stressed, best, runs))
    return Results(machine(), seconds, rounds, latencies, factor)


def _show_progress(what: str, stressed: bool, priority: int) -> None:
    progress(what, load(stressed), f"{scheduling(priority)} scheduling")


def markdown(results: Results) -> str:
    """Return the machine, the goals, and a row for each round."""
    heads = ["tick", "machine", "scheduling"]
    heads += [late.contestant for late in results.rounds[0].lateness]
    heads += ["missed", "whole tick", "until written", "CPU"]
    rows = [
        [
            *_conditions(round_),
            *(f"{o.p50:.0f}/{o.p99:.0f}/{o.worst:.0f}" for o in round_.lateness),
            "/".join(f"{late.missed:.3%}" for late in round_.lateness),
            _percentiles(round_.fishd.timing.duration),
            _percentiles(round_.fishd.sealed),
            f"{round_.fishd.cpu:.1%}",
        ]
        for round_ in results.rounds
    ]
    about = (
        f"Lateness over {results.seconds:g} s, p50/p99/worst, and duration of a fishd tick, "
        "p50/p99 [µs]:"
    )
    return "\n\n".join(
        (
            "; ".join(f"{name}: {value}" for name, value in results.machine.items()) + ".",
            table("goal | idle | met | under load | met", goals(results)),
            about,
            table(" | ".join(heads), rows),
        )
    )


def goals(results: Results) -> list[list[str]]:
    """Return one row per goal: the goal, and the results idle and under load."""
    best = max(round_.priority for round_ in results.rounds)  # the scheduler of a robot

    def judged(
        goal: str,
        limit: float,
        form: str,
        figure: Callable[[Round], float | None],
        tick: float = TICK,
        priority: int = best,
    ) -> list[str]:
        idle, busy = (
            figure(round_)
            for round_ in results.rounds
            if round_.tick == tick and round_.priority == priority
        )
        return [goal, *_verdict(idle, limit, form), *_verdict(busy, limit, form)]

    late, us = "lateness p99 ≤ 2 × that of cyclictest", "{:.0f} µs"
    idle, busy = results.latencies
    factor = results.real_time_factor
    return [
        *(
            judged(f"{late}, {scheduling(p)} scheduling", 2, "{:.2f} ×", _to_cyclictest, priority=p)
            for p in sorted({round_.priority for round_ in results.rounds})
        ),
        judged("busy time p50 ≤ 100 µs", 100, us, lambda r: r.fishd.timing.duration.p50),
        judged("busy time p99 ≤ 250 µs", 250, us, lambda r: r.fishd.timing.duration.p99),
        judged(
            "processor time of a tick, with a subscriber ≤ 0.8 ms",
            0.8,
            "{:.2f} ms",
            lambda r: 1e3 * r.tick * r.fishd.cpu,
        ),
        judged(
            "2 ms tick, < 0.1 % missed", 1e-3, "{:.3%}", lambda r: r.lateness[0].missed, tick=FAST
        ),
        judged("RSS ≤ 62 MB", 62, "{:.0f} MB", lambda r: r.fishd.rss),
        ["first tick ≤ 0.25 s", *_verdict(idle.first_tick, 0.25), *_verdict(busy.first_tick, 0.25)],
        ["fishctl status ≤ 0.08 s", *_verdict(idle.status, 0.08), *_verdict(busy.status, 0.08)],
        [
            "virtual time ≥ 1400 × real time",
            f"{factor:.0f} ×",
            "yes" if factor >= 1400 else "**no**",
            "not measured",
            "",
        ],
    ]


def _to_cyclictest(round_: Round) -> float | None:
    fishd, *others = round_.lateness
    return next((fishd.p99 / o.p99 for o in others if o.contestant == "cyclictest"), None)


def _verdict(value: float | None, limit: float, form: str = "{:.2f} s") -> list[str]:
    if value is None:
        return ["not measured", ""]
    return [form.format(value), "yes" if value <= limit else "**no**"]


def _conditions(round_: Round) -> list[str]:
    return [f"{round_.tick * 1e3:g} ms", load(round_.stressed), scheduling(round_.priority)]


def _percentiles(times: Percentiles) -> str:
    return f"{times.p50:.0f}/{times.p99:.0f}"


OPTIONS: Options = {
    "--seconds": {"type": float, "help": "per round; default 60, to compare 10"},
    "--quick": {"action": "store_true", "help": "5 s per round, for a rough look"},
    "--against": {"type": Path, "metavar": "CHECKOUT", "help": "compare this fishd with that one"},
    "--rounds": {"type": int, "default": 10, "help": "turns of each, with --against; default 10"},
}


def measure(options: Namespace) -> Report:
    """Measure this fishd, or compare it with another one."""
    if options.against:
        return compare(options.against, options.seconds or 10.0, options.rounds)
    seconds, runs = (5.0, 3) if options.quick else (options.seconds or 60.0, 7)
    results = measure_all(seconds, runs)
    return Report({"bench tick": markdown(results)}, results)
