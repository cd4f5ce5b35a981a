"""What a training is asked to do, and how it ended."""

import math
from pathlib import Path
from typing import Literal

from msgspec import Struct

from fishd.camera.simulated.settings import SimulatedCameraSettings
from fishd.config import Config
from fishd.core.errors import ConfigError
from fishd.lab.experiment import On
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.env.simulated_link import Camera
from fishd.learning.settings import Randomisation, TrainingSettings

Ended = Literal["finished", "interrupted", "lost", "diverged", "failed"]


class Job(Struct, frozen=True, kw_only=True):
    """What to train, on what, and where to keep it."""

    config: Config
    """The fish; on a robot, the one that the scales are made for."""
    settings: TrainingSettings
    folder: Path
    """The run folder: a new one, or that of the run to resume."""
    on: On = "simulation"
    """A fish in this process on the virtual clock, or that of a running fishd."""
    endpoint: str | None = None
    """Control socket of that fishd; None looks for the one on this machine."""
    take: bool = False
    """Take that fish from an experiment that holds it."""
    agent: str | None = None
    """Where that fishd reaches this program; None: any free port, for a fishd on this machine."""
    resume: bool = False
    """Go on from the newest checkpoint in `folder`."""
    parent: Path | None = None
    """Checkpoint whose networks a new run begins with."""

    camera: SimulatedCameraSettings = SimulatedCameraSettings()
    """What a simulated fish is seen with, where it is to be seen."""
    camera_endpoint: str | None = None
    """Where the camera of a robot takes requests; None: $FISHD_CAMERA, or that of this machine."""

    @property
    def simulated_camera(self) -> Camera | None:
        """That camera, and what is shown of it; None where only forces are seen."""
        if self.settings.see == "force":
            return None
        return Camera(self.camera, self.settings.camera.stack)

    def check(self) -> None:
        """Refuse what a robot has nothing to learn from; raises `ConfigError`."""
        if self.on == "live" and self.is_begun and not self.settings.steps:
            raise ConfigError(
                "steps: 0 is not valid on a robot, which does not imitate: it would learn nothing; "
                "give --steps"
            )
        if self.on == "live" and self.settings.imitation.rounds and not self.is_begun:
            raise ConfigError(
                "imitation.rounds: the best beat of a robot's fish is not known: learn from "
                "simulated ones, and go on here with --from; or set it to 0"
            )

    @property
    def is_begun(self) -> bool:
        """Does it begin with networks that have learned something?"""
        return self.resume or self.parent is not None

    @property
    def cleans_rewards(self) -> bool:
        """Is a sensor's drift and turn to be found? That takes more than an episode of one fish."""
        one_fish = self.on == "live" or self.settings.randomisation == Randomisation()
        return self.settings.ppo.clean_rewards and one_fish

    def last_step(self, done: int = 0) -> int:
        """The step with which it ends: PPO learns from whole rollouts; done: steps before."""
        rollout = self.settings.ppo.n_steps
        return done + math.ceil((self.settings.steps - done) / rollout) * rollout


class Outcome(Struct, frozen=True, kw_only=True):
    """How a training ended."""

    folder: Path
    steps: int = 0
    """Control steps that were learned from."""
    dropped: int = 0
    """Steps of a rollout that was stopped midway: nothing was learned from them."""
    tank_time: float = 0.0
    """[s]"""
    ended: Ended
    """failed: one of several seeds raised an exception."""
    message: str = ""
    """Why, where it has neither done all steps nor was interrupted by the user."""
    checkpoint: Path | None = None
    """The newest."""
    best: Path | None = None
    """The checkpoint of `best_evaluation`."""
    latest_evaluation: Evaluation | None = None
    best_evaluation: Evaluation | None = None
