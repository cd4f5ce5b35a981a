"""Measures how long the controller `remote` waits for an agent in another process.

    python tools/bench_remote.py                            the table of docs/remote.md
    python tools/bench_remote.py --write docs/remote.md     put it there
    python tools/bench_remote.py --quick                    ticks of 5 ms only, half a minute

A round trip begins when a tick is about to send its observation, and ends when it has the action.
The agent is `fishd.client.Agent`, a Python program that answers at once: at normal priority and,
where that is permitted, under SCHED_FIFO as well.
"""

import argparse
import asyncio
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import quantiles

import zmq
from bench_machine import PRIORITY, fifo_permitted, machine
from msgspec import Struct
from reports import put, table

from fishd import realtime
from fishd.build import build_loop
from fishd.clock import SystemClock, Ticker
from fishd.config import Config, load
from fishd.hardware.simulated import SimulatedFish
from fishd.rehearsal import rehearsal
from fishd.remote.controller import Remote
from fishd.remote.parameters import RemoteParameters
from fishd.signals import Observation
from fishd.telemetry import Telemetry

GOAL = 2e-3
"""Longest round trip that is asked for, at p99 [s]."""
AGENT_PRIORITY = 40
"""Below that of fishd."""
AGENT = """
import sys
from fishd.client import Agent

with Agent(sys.argv[1], timeout=30.0) as agent:
    print(agent.address, flush=True)
    for seen in agent:
        agent.act(0.4 if seen.fin_velocity > 0.0 else -0.4)
"""


class Trips(Struct, frozen=True):
    """The round trips of one run."""

    transport: str
    tick: float
    """[s]"""
    priority: int
    """SCHED_FIFO priority of the agent; 0 for the normal scheduler."""
    times: list[float]
    """[s]"""
    late: int
    """Ticks whose deadline, 0.45 of a tick, was not met."""


class TimedRemote(Remote):
    """`remote`, with a stopwatch around it once its agent has answered for the first time."""

    def __init__(self, agent: str, config: Config) -> None:
        parameters = RemoteParameters(agent=agent, deadline=0.45 * config.tick, misses=1000)
        super().__init__(parameters, config.limits)
        self.times: list[float] = []
        self.late = 0

    def update(self, observation: Observation) -> float:
        """Ask, and take the time."""
        begun = time.perf_counter()
        command = super().update(observation)
        if command != 0.0 or self.times:
            self.times.append(time.perf_counter() - begun)
            self.late += command == 0.0
        return command


@contextmanager
def agent_process(address: str, priority: int) -> Iterator[str]:
    """An agent that answers at once, and where."""
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
    """Tick as the daemon does until there are so many round trips."""
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
    publisher = Telemetry(context, f"inproc://{id(controller)}")
    # As in the daemon: once there is a thread of ZeroMQ, which is to have the priority as well.
    realtime.enter(PRIORITY if fifo_permitted() else 0, lock_memory=False)
    fish = SimulatedFish(config.plant, config.simulation, config.tick)
    loop = build_loop(config, fish.robot(), SystemClock(), publisher)
    loop.set_controller("remote", controller)
    ticker = Ticker(config.tick, rehearsal(config, context))
    realtime.quiet_garbage_collector()
    async for slot in ticker:
        loop.tick(slot)
        if loop.supervisor.reason:
            raise SystemExit(f"bench_remote: {loop.supervisor.reason.message}")
        if len(controller.times) >= trips:
            break
    ticker.close()
    loop.close()


def measure(transport: str, tick: float, priority: int, trips: int) -> Trips:
    """One run over `ipc` or `tcp`, in this process, which is to do nothing else."""
    config = load(None, [f"tick={tick}"])
    with tempfile.TemporaryDirectory() as folder:
        wanted = f"ipc://{folder}/agent" if transport == "ipc" else "tcp://127.0.0.1:*"
        with agent_process(wanted, priority) as address:
            controller = TimedRemote(address, config)
            asyncio.run(swim(controller, config, trips))
    return Trips(transport, tick, priority, controller.times, controller.late)


def row(trips: Trips) -> list[str]:
    """What a run came to, and whether that is what was asked for."""
    # Not the default method, which goes beyond the worst of fewer than 999 trips.
    cuts = quantiles(trips.times, n=1000, method="inclusive")
    p50, p99 = cuts[499], cuts[989]
    figures = (p50, p99, cuts[998], max(trips.times))
    return [
        trips.transport,
        f"{trips.tick * 1e3:g} ms",
        f"SCHED_FIFO {trips.priority}" if trips.priority else "normal",
        str(len(trips.times)),
        *(f"{value * 1e6:.0f}" for value in figures),
        str(trips.late),
        "yes" if p99 <= GOAL else "**no**",
    ]


def main() -> None:
    """Parse the command line, measure, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--trips", type=int, default=2000, help="per run (default: 2000)")
    parser.add_argument("--quick", action="store_true", help="ticks of 5 ms only")
    parser.add_argument("--write", type=Path, metavar="FILE", help="replace the table in FILE")
    options = parser.parse_args()
    fifo = fifo_permitted()
    ticks = (0.005,) if options.quick else (0.005, 0.05)
    priorities = (0, AGENT_PRIORITY) if fifo and shutil.which("chrt") else (0,)
    rows = [
        row(measure(transport, tick, priority, options.trips))
        for priority in priorities
        for tick in ticks
        for transport in ("ipc", "tcp")
    ]
    head = [
        "over",
        "tick",
        "agent",
        "trips",
        "p50 [µs]",
        "p99 [µs]",
        "p99.9 [µs]",
        "worst [µs]",
        "late",
        "p99 ≤ 2 ms",
    ]
    facts = machine()
    text = (
        f"{facts['CPU']}, {facts['Cores']} cores; Python {facts['Python']}; fishd's loop under "
        f"{f'SCHED_FIFO {PRIORITY}' if fifo else 'normal'} scheduling.\n\n" + table(head, rows)
    )
    if options.write:
        put(options.write, "bench_remote", text)
    print(text)


if __name__ == "__main__":
    main()
