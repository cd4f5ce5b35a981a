"""Time that the controller `remote` waits for an agent in another process.

A round trip begins when a tick is about to send its observation, and ends when it has the action.
The agent is `fishd.client.Agent`, a Python program that answers at once: at normal priority and,
where that is permitted, under SCHED_FIFO as well.
"""

import asyncio
import shutil
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import quantiles

from msgspec import Struct

from common.machine import PRIORITY, fifo_permitted, machine_in_short, priorities, scheduling
from common.report import Options, Report, progress, table
from fishd.assembly import build_loop, simulated_fish
from fishd.config import Config, load
from fishd.controllers.remote.controller import Remote, RemoteParameters
from fishd.core.clock import SystemClock, Ticker
from fishd.core.process import realtime
from fishd.core.signals import Observation
from fishd.daemon.gateway.gateways import Telemetry
from fishd.daemon.warm_up import mock_ticks

DOCUMENT = "how-to/remote.md"
GOAL = 2e-3
"""Goal for the round trip, p99 [s]."""
AGENT_PRIORITY = 40
"""SCHED_FIFO priority of the agent, below that of fishd."""
HEAD = (
    "over | tick | agent | trips | p50 [µs] | p99 [µs] | p99.9 [µs] | worst [µs] | late | "
    "p99 ≤ 2 ms"
)
AGENT = """
import sys
from fishd.client import Agent

with Agent(sys.argv[1], timeout=30.0) as agent:
    print(agent.address, flush=True)
    for seen in agent:
        agent.act(0.4 if seen.fin_velocity > 0.0 else -0.4)
"""


class Trips(Struct, frozen=True):
    """Round trips of one run."""

    transport: str
    tick: float
    """[s]"""
    priority: int
    """SCHED_FIFO priority of the agent; 0 for the normal scheduler."""
    times: list[float]
    """[s]"""
    late: int
    """Number of ticks whose deadline, 0.45 of a tick, was missed."""


class TimedRemote(Remote):
    """Controller `remote` with a timer, which starts after the first answer of its agent."""

    def __init__(self, agent: str, config: Config) -> None:
        parameters = RemoteParameters(agent=agent, deadline=0.45 * config.tick, misses=1000)
        super().__init__(parameters, config.limits)
        self.times: list[float] = []
        self.late = 0

    def update(self, observation: Observation) -> float:
        """Update the controller, and record the time."""
        begun = time.perf_counter()
        command = super().update(observation)
        if command != 0.0 or self.times:
            self.times.append(time.perf_counter() - begun)
            self.late += command == 0.0
        return command


@contextmanager
def agent_process(address: str, priority: int) -> Iterator[str]:
    """Start an agent that answers at once, and yield its address."""
    under = ["chrt", "-f", str(priority)] if priority else []
    process = subprocess.Popen(
        [*under, sys.executable, "-c", AGENT, address], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout
        yield process.stdout.readline().strip()
    finally:
        process.kill()
        process.wait()


async def swim(controller: TimedRemote, config: Config, trips: int) -> None:
    """Tick like the daemon until there are `count` round trips."""
    realtime.enter(PRIORITY if fifo_permitted() else 0, lock_memory=False)
    fish = simulated_fish(config)
    loop = build_loop(config, fish.robot(), SystemClock(), Telemetry(lambda message: None))
    loop.set_controller("remote", controller)
    ticker = Ticker(config.tick, mock_ticks(config))
    realtime.freeze_garbage_collector()
    async for slot in ticker:
        loop.tick(slot)
        if loop.supervisor.reason:
            raise SystemExit(f"bench remote: {loop.supervisor.reason.message}")
        if len(controller.times) >= trips:
            break
    ticker.close()
    loop.close()


def round_trips(transport: str, tick: float, priority: int, trips: int) -> Trips:
    """Return one run over `ipc` or `tcp`, in this process, which does nothing else."""
    config = load(None, [f"tick={tick}"])
    with tempfile.TemporaryDirectory() as folder:
        wanted = f"ipc://{folder}/agent" if transport == "ipc" else "tcp://127.0.0.1:*"
        with agent_process(wanted, priority) as address:
            controller = TimedRemote(address, config)
            asyncio.run(swim(controller, config, trips))
    return Trips(transport, tick, priority, controller.times, controller.late)


def row(trips: Trips) -> list[str]:
    """Return the row of a run, and whether it meets the goal."""
    # The default method would extrapolate beyond the worst of fewer than 999 trips.
    cuts = quantiles(trips.times, n=1000, method="inclusive")
    p50, p99 = cuts[499], cuts[989]
    figures = (p50, p99, cuts[998], max(trips.times))
    return [
        trips.transport,
        f"{trips.tick * 1e3:g} ms",
        scheduling(trips.priority),
        str(len(trips.times)),
        *(f"{value * 1e6:.0f}" for value in figures),
        str(trips.late),
        "yes" if p99 <= GOAL else "**no**",
    ]


OPTIONS: Options = {
    "--trips": {"type": int, "default": 2000, "help": "per run (default: 2000)"},
    "--quick": {"action": "store_true", "help": "ticks of 5 ms only, half a minute"},
}


def measure(options: Namespace) -> Report:
    """Measure every tick over every transport, with an agent of every priority."""
    runs = []
    for priority in priorities(AGENT_PRIORITY) if shutil.which("chrt") else (0,):
        for tick in (0.005,) if options.quick else (0.005, 0.05):
            for transport in ("ipc", "tcp"):
                runs.append(round_trips(transport, tick, priority, options.trips))
                progress(*row(runs[-1]))
    text = f"{machine_in_short()}\n\n{table(HEAD, map(row, runs))}"
    return Report({"bench remote": text}, runs)
