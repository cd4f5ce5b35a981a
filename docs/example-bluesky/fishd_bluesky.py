"""A fish of fishd for Bluesky: set the frequency of its tail, and read its mean thrust.

    import bluesky.plans as bp
    from bluesky import RunEngine
    from fishd_bluesky import SwimmingFish

    fish = SwimmingFish()
    RunEngine()(bp.scan([fish], fish.frequency, 1.0, 2.5, 7), print)

It needs a running fishd and the packages fishd and bluesky.
"""

import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

from fishd.client import Fish

KEYS = "thrust", "thrust_ci95"
"""Fields of the tick in a reading."""


class Task:
    """Task in another thread, as a `Status` of Bluesky."""

    def __init__(self, future: "Future[Any]") -> None:
        self._future = future

    @property
    def done(self) -> bool:
        """Whether the task has ended."""
        return self._future.done()

    @property
    def success(self) -> bool:
        """Whether the task has ended without an error."""
        return self.done and self._future.exception() is None

    def exception(self, timeout: float | None = 0.0) -> BaseException | None:
        """Return the error of the task; raise TimeoutError while it runs."""
        return self._future.exception(timeout)

    def add_callback(self, callback: Callable[["Task"], None]) -> None:
        """Call a function at the end of the task, or now if it has ended."""
        self._future.add_done_callback(lambda _: callback(self))


class Frequency:
    """Frequency of the tail, which a scan sets."""

    def __init__(self, fish: "SwimmingFish") -> None:
        self.name, self.parent = f"{fish.name}_frequency", fish
        self.hints = {"fields": [self.name]}
        self.value = math.nan

    def set(self, value: float) -> Task:
        """Swim with a frequency [Hz]; the task ends when fishd has accepted it."""
        value, controller = float(value), self.parent.controller  # plans give numbers of NumPy
        self.value = value
        return self.parent.start(lambda fish: fish.set_controller(controller, frequency=value))

    def read(self) -> dict[str, Any]:
        """Return the latest frequency."""
        return {self.name: {"value": self.value, "timestamp": time.time()}}

    def describe(self) -> dict[str, Any]:
        """Return source, type and unit."""
        return self.parent.describe_number(self.name, "Hz")


class SwimmingFish:
    """Fish under the control of a plan, from `stage` to `unstage`; a scan reads its thrust."""

    parent = None

    def __init__(
        self,
        name: str = "fish",
        endpoint: str | None = None,
        controller: str = "square",
        seconds: float = 6.0,
    ) -> None:
        """
        endpoint: control socket of fishd; None for the fishd of this machine
        controller: controller with a parameter `frequency`
        seconds: swim before a reading; 2 s for the fin to settle, and 4 s that fishd averages over
        """
        self.name, self.endpoint, self.controller = name, endpoint, controller
        self.seconds = seconds
        self.hints = {"fields": [f"{name}_thrust"]}
        self.frequency = Frequency(self)
        self._reading: dict[str, Any] = {}
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="fish")  # a Fish is for one thread
        self._stack = ExitStack()
        self._fish: Fish | None = None

    def stage(self) -> list[Any]:
        """Take the lease of the fish; raise `FishError` if fishd does not give it."""
        self._thread.submit(self._take).result()
        return [self]

    def unstage(self) -> list[Any]:
        """Give the lease back: the fish goes to neutral."""
        self._thread.submit(self._stack.close).result()
        return [self]

    def trigger(self) -> Task:
        """Swim for `seconds`, and keep the thrust at the end of them."""
        return self.start(self._measure)

    def read(self) -> dict[str, Any]:
        """Return thrust, half-width of its 95 % interval (NaN: unknown), and frequency."""
        return self._reading | self.frequency.read()

    def describe(self) -> dict[str, Any]:
        """Return source, type and unit of each number."""
        forces = (self.describe_number(f"{self.name}_{key}", "N") for key in KEYS)
        return self.frequency.describe() | next(forces) | next(forces)

    def describe_number(self, key: str, unit: str) -> dict[str, Any]:
        """Return the description of a number."""
        source = f"fishd:{self.endpoint or 'this machine'}"
        return {key: {"source": source, "dtype": "number", "shape": [], "units": unit}}

    def start(self, task: Callable[[Fish], object]) -> Task:
        """Start a task with the staged fish."""
        if self._fish is None:
            raise RuntimeError(f"{self.name} is not staged: use it in a plan such as bp.scan")
        return Task(self._thread.submit(task, self._fish))

    def _take(self) -> None:
        with ExitStack() as stack:
            stack.callback(setattr, self, "_fish", None)
            self._fish = stack.enter_context(Fish(self.endpoint))
            stack.enter_context(self._fish.lease("bluesky", idle_limit=None))
            self._stack = stack.pop_all()

    def _measure(self, fish: Fish) -> None:
        end = math.inf
        for tick in fish.ticks():
            end = min(end, tick.time + self.seconds)
            if tick.time >= end:
                break
        for key, value in zip(KEYS, (tick.thrust, tick.thrust_ci95 or math.nan), strict=True):
            self._reading[f"{self.name}_{key}"] = {"value": value, "timestamp": tick.t}
