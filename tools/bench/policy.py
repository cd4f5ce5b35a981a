"""Cost of a policy in the tick: one update of the controller `ppo`.

The first measurement is the loop on the virtual clock, with updates in direct succession, in turn
with the controller `hold`, whose update does nothing. The second one is a real fishd, whose update
follows 50 ms of sleep, with and without warmed-up ticks.
"""

import itertools
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from common.daemon import Fishd
from common.machine import machine_in_short
from common.report import Options, Report, quantile, table
from fishd import __version__
from fishd.assembly import build_loop, simulated_fish
from fishd.config import Config, load
from fishd.control.loop import ControlLoop
from fishd.controllers import registry
from fishd.controllers.policy.card import Card, Feature, Provenance
from fishd.controllers.policy.network import to_onnx
from fishd.core.clock import VirtualClock, virtual_slots
from fishd.core.signals import Event, Observation, Percentiles, Tick

DOCUMENT = "reference/policies.md"
GOAL = 50.0
"""Goal for the time of an update, p99 [µs]."""
BLOCK = 500
"""Number of updates per turn of a controller."""
RIG = ("simulation.noise=1e-3", "simulation.offset_y=5e-3")
HEAD = "controller | where | updates | p50 [µs] | p99 [µs] | worst [µs]"


class Deaf:
    """Publisher that ignores everything."""

    def tick(self, tick: Tick) -> None:
        """Ignore the tick."""

    def event(self, event: Event) -> None:
        """Drop."""


def random_policy() -> bytes:
    """Return a 64 × 64 tanh network with random weights and the default observation."""
    draw = np.random.default_rng(0)
    sizes = (5, 64, 64, 1)
    layers = [
        (draw.normal(0.0, before**-0.5, (after, before)), draw.normal(0.0, 0.1, after))
        for before, after in itertools.pairwise(sizes)
    ]
    features = (
        Feature("fy", 0.39),
        Feature("fy_rate", 4.9),
        Feature("instruction_angle", 0.42),
        Feature("previous_angle", 0.42),
        Feature("fin_velocity", 0.031),
    )
    provenance = Provenance(
        created="",
        fishd=__version__,
        algorithm="random numbers",
        on="nothing",
        steps=0,
        seed=0,
        settings={},
        plant={},
        libraries={"numpy": np.__version__},
    )
    card = Card(observation=features, tick=0.05, amplitude=0.42, provenance=provenance)
    return to_onnx(layers, "tanh", card)


class Swimmer:
    """Controller in a loop on the virtual clock, with a timer around its update."""

    def __init__(self, config: Config, name: str, parameters: dict[str, Any]) -> None:
        clock = VirtualClock()
        fish = simulated_fish(config)
        self._loop: ControlLoop = build_loop(config, fish.robot(), clock, Deaf())
        controller = registry.create(name, parameters, config.limits)
        self.times: list[int] = []
        controller.update = self._timed(controller.update)  # type: ignore[method-assign]
        self._loop.set_controller(name, controller)
        self._slots = virtual_slots(clock, config.tick)

    def swim(self, ticks: int) -> None:
        """Run the loop."""
        for slot in itertools.islice(self._slots, ticks):
            self._loop.tick(slot)
        if self._loop.supervisor.reason:
            raise SystemExit(self._loop.supervisor.reason.message)

    def percentiles(self) -> Percentiles:
        """Return the percentiles of all updates except those of the first block [µs]."""
        times = [nanoseconds / 1e3 for nanoseconds in self.times[BLOCK:]]
        return Percentiles(quantile(times, 0.5), quantile(times, 0.99), max(times), 0)

    def _timed(self, update: Callable[[Observation], float]) -> Callable[[Observation], float]:
        clock, times = time.perf_counter_ns, self.times

        def timed(observation: Observation) -> float:
            begun = clock()
            angle = update(observation)
            times.append(clock() - begun)
            return angle

        return timed


def in_virtual_time(policy: str, updates: int) -> Iterator[list[str]]:
    """Return the rows of both controllers, which run in turn."""
    config = load(None, RIG)
    swimmers = {
        "hold": Swimmer(config, "hold", {}),
        "ppo": Swimmer(config, "ppo", {"policy": policy}),
    }
    for _ in range(1 + -(-updates // BLOCK)):
        for swimmer in swimmers.values():
            swimmer.swim(BLOCK)
    for name, swimmer in swimmers.items():
        count = len(swimmer.times) - BLOCK
        yield _row(name, "virtual clock", count, swimmer.percentiles())


def in_real_time(policy: str, seconds: float) -> Iterator[list[str]]:
    """Return the rows of daemons that run at the same time, with the policy and with `hold`."""
    with ExitStack() as stack:
        started = []
        for name, parameters in (("hold", ()), ("ppo", (f"start.parameters.policy={policy}",))):
            for warm_up, where in (("true", "fishd"), ("false", "fishd, not warmed up")):
                own = (f"start.controller={name}", *parameters, f"realtime.warm_up={warm_up}")
                fishd = stack.enter_context(Fishd(*RIG, *own))
                started.append((name, where, fishd))
        for _, _, fishd in started:
            fishd.next_tick()
        time.sleep(seconds)
        for name, where, fishd in started:
            status = fishd.status()
            if status.reason:
                raise SystemExit(f"{name}: {status.reason.message}")
            yield _row(name, where, status.seq, status.timing.phases["update"])


def _row(name: str, where: str, updates: int, figures: Percentiles) -> list[str]:
    times = (f"{value:.1f}" for value in (figures.p50, figures.p99, figures.worst))
    return [f"`{name}`", where, str(updates), *times]


@contextmanager
def policy_file(given: str | None) -> Iterator[str]:
    """Return the file of the policy: the given one, or that of a new random one."""
    if given:
        yield str(Path(given).absolute()) if "/" in given or given.endswith(".onnx") else given
        return
    with tempfile.TemporaryDirectory(prefix="fishd-") as folder:
        path = Path(folder) / "random.onnx"
        path.write_bytes(random_policy())
        yield str(path)


OPTIONS: Options = {
    "--updates": {"type": int, "default": 20_000, "help": "in virtual time (20000)"},
    "--seconds": {"type": float, "default": 60.0, "help": "of real time (60)"},
    "--policy": {"metavar": "NAME|FILE", "help": "not one of random weights, 64 × 64 tanh"},
}


def measure(options: Namespace) -> Report:
    """Return the tables of virtual and real time."""
    with policy_file(options.policy) as policy:
        rows = [*in_virtual_time(policy, options.updates), *in_real_time(policy, options.seconds)]
    met = "met" if float(rows[1][4]) <= GOAL else "**not met**"
    verdict = f"Goal, p99 ≤ {GOAL:g} µs where one update follows the other: {met}."
    text = f"{table(HEAD, rows)}\n\n{verdict} {machine_in_short()}"
    return Report({"bench policy": text}, rows)
