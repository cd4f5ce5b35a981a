"""Short trainings, and links that pause, lose actions or fail, for tests of learning."""

import csv
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from fishd.config import load
from fishd.core.signals import Observation
from fishd.learning.links.link import LinkLost, StepResult
from fishd.learning.links.simulated_link import SimulatedLink
from fishd.learning.settings import EvaluationSettings, PpoSettings, TrainingSettings
from fishd.learning.train.jobs import Job
from rigs.harness import PINNED_TICK
from rigs.processes import fishctl

LONG_ENOUGH = 120.0
"""Longest time until a training has a result, including the import of torch [s]."""
Done = subprocess.CompletedProcess[str]
NOISY = (PINNED_TICK, "simulation.noise=0.001", "simulation.offset_y=0.005")
BRIEF = TrainingSettings(
    steps=128,
    ppo=PpoSettings(n_steps=64, n_epochs=4, log_std_init=0.7),
    evaluation=EvaluationSettings(every=1, patience=None, seconds=4.0, settle=2.0),
)
"""Settings of two short updates, each followed by a short evaluation, with less exploration."""


def brief_job(folder: Path, **changes: Any) -> Job:
    """Return a training of a second; changes: of its settings, or of fields of the job."""
    fields = {name: changes.pop(name) for name in ("on", "resume", "parent") if name in changes}
    settings = replace(BRIEF, **changes)
    return Job(config=load(None, NOISY), settings=settings, folder=folder, **fields)


def rows(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV file with a head."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def wait_for(what: Callable[[], object]) -> None:
    deadline = time.monotonic() + LONG_ENOUGH
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def while_it_trains(what: Callable[[], object], act: Callable[[], None], *words: str) -> Done:
    """Run a training, act when a condition is true, and return the result of fishctl."""

    def wait_and_act() -> None:
        try:
            wait_for(what)
        finally:
            act()

    with ThreadPoolExecutor(1) as pool:
        acted = pool.submit(wait_and_act)
        done = fishctl(*words)
        acted.result()
    return done


class Resting(SimulatedLink):
    """Fish that rests while the agent learns, like a real one."""

    def __init__(self, job: Job) -> None:
        super().__init__(job.config)
        self.shown: list[Observation] = []
        """All observations of the agent."""

    def resume(self) -> Observation:  # also called by the first reset
        observation = super().resume()
        self.shown.append(observation)
        return observation

    def step(self, angle: float) -> StepResult:
        sensed = super().step(angle)
        self.shown.append(sensed.observation)
        return sensed

    def pause(self, seconds: float) -> None:
        for _ in range(60):
            super().step(0.0)


class Losing(SimulatedLink):
    """Link that delays every `one_in`-th action by a tick."""

    def __init__(self, job: Job, every: int = 10) -> None:
        super().__init__(job.config)
        self._every = every
        self._steps = 0

    def step(self, angle: float) -> StepResult:
        self._steps += 1
        if self._steps % self._every:
            return super().step(angle)
        super().step(0.0)
        return StepResult(super().step(angle).observation, lost=1)


class Failing(SimulatedLink):
    """Fish that is lost after some steps."""

    def __init__(self, job: Job, steps: int) -> None:
        super().__init__(job.config)
        self._left = steps
        self.closed = 0

    def step(self, angle: float) -> StepResult:
        self._left -= 1
        if self._left < 0:
            raise LinkLost("fishd is in mode fault: the newest force sample is 150 ms old")
        return super().step(angle)

    def close(self) -> None:
        self.closed += 1
