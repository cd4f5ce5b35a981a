"""What tests of learning are built from: short trainings, and links that pause, lose or fail."""

import csv
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from fishd.config import load
from fishd.learning.in_process import InProcess
from fishd.learning.jobs import Job
from fishd.learning.link import LinkLost, Sensed
from fishd.learning.settings import EvaluationSettings, PpoSettings, TrainingSettings
from fishd.signals import Observation

NOISY = ("simulation.noise=0.001", "simulation.offset_y=0.005")
BRIEF = TrainingSettings(
    steps=128,
    ppo=PpoSettings(n_steps=64, n_epochs=4),
    evaluation=EvaluationSettings(seconds=4.0, settle=2.0),
)
"""Two short updates, each followed by a short evaluation."""


def brief_job(folder: Path, **changes: Any) -> Job:
    """A training of a second; changes: to its settings, or fields of the job."""
    fields = {name: changes.pop(name) for name in ("on", "resume", "parent") if name in changes}
    return Job(
        config=load(None, NOISY), settings=replace(BRIEF, **changes), folder=folder, **fields
    )


def rows(path: Path) -> list[dict[str, str]]:
    """A CSV file with a head."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


class Resting(InProcess):
    """A fish that comes to rest while the agent learns, as a real one does."""

    def __init__(self, job: Job) -> None:
        super().__init__(job.config)
        self.shown: list[Observation] = []
        """Everything that the agent was shown."""

    def start(self) -> Observation:
        found = super().start()
        self.shown.append(found)
        return found

    def step(self, angle: float) -> Sensed:
        sensed = super().step(angle)
        self.shown.append(sensed.observation)
        return sensed

    def pause(self, seconds: float) -> None:
        for _ in range(60):
            super().step(0.0)


class Losing(InProcess):
    """A link over which one action in so many comes a tick too late."""

    def __init__(self, job: Job, every: int = 10) -> None:
        super().__init__(job.config)
        self._every = every
        self._steps = 0

    def step(self, angle: float) -> Sensed:
        self._steps += 1
        if self._steps % self._every:
            return super().step(angle)
        super().step(0.0)
        return Sensed(super().step(angle).observation, lost=1)


class Failing(InProcess):
    """A fish that is gone after some steps."""

    def __init__(self, job: Job, steps: int) -> None:
        super().__init__(job.config)
        self._left = steps
        self.closed = 0

    def step(self, angle: float) -> Sensed:
        self._left -= 1
        if self._left < 0:
            raise LinkLost("fishd is in mode fault: the newest force sample is 150 ms old")
        return super().step(angle)

    def close(self) -> None:
        self.closed += 1
