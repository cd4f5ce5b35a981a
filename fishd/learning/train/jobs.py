"""The job of a training, and its outcome."""

import math
from pathlib import Path
from typing import Literal

from msgspec import Struct

from fishd.camera.simulated import SimulatedCameraSettings
from fishd.config import Config
from fishd.core.errors import ConfigError
from fishd.lab.experiment import On
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.links.simulated_link import Camera
from fishd.learning.settings import Randomisation, TrainingSettings
from fishd.virtual.plant.batch import is_possible

Ended = Literal["finished", "interrupted", "lost", "diverged", "failed"]


class Job(Struct, frozen=True, kw_only=True):
    """The job of a training: settings, fish and run folder."""

    config: Config
    """Configuration of the fish; on a robot, that which the scales are computed from."""
    settings: TrainingSettings
    folder: Path
    """The run folder: a new one, or that of the run to resume."""
    on: On = "simulation"
    """Fish to train on: a simulated one in this process on the virtual clock, or that of fishd."""
    endpoint: str | None = None
    """Control socket of fishd; None looks for the fishd on this machine."""
    take: bool = False
    """Whether to take the fish from an experiment that holds it."""
    agent: str | None = None
    """Address at which fishd reaches this program; None: any free port, for a local fishd."""
    resume: bool = False
    """Whether to continue from the newest checkpoint in `folder`."""
    parent: Path | None = None
    """Checkpoint whose networks a new run begins with."""

    command: tuple[str, ...] = ()
    """Arguments of `fishctl learn ppo`."""
    camera: SimulatedCameraSettings = SimulatedCameraSettings()
    """Camera that sees a simulated fish, if `settings.see` needs one."""
    camera_endpoint: str | None = None
    """Request address of a robot's camera; None: $FISHD_CAMERA, or the camera of this machine."""

    @property
    def simulated_camera(self) -> Camera | None:
        """Simulated camera and its stack of frames; None where only forces are seen."""
        if self.settings.see == "force":
            return None
        return Camera(self.camera, self.settings.camera.stack)

    def check(self) -> None:
        """Raise `ConfigError` for a job from which a robot cannot learn."""
        if self.on == "live" and self.is_begun and not self.settings.steps:
            raise ConfigError(
                "steps: 0 is not valid on a robot, which does not imitate: it would learn nothing; "
                "give --steps"
            )
        if self.on == "live" and self.settings.imitation.rounds and not self.is_begun:
            raise ConfigError(
                "imitation.rounds: the best beat of a robot's fish is not known: learn from "
                "simulated ones, and go on here with --fine-tune; or set it to 0"
            )
        imitation = self.settings.imitation
        plants = self.settings.randomisation.fish or (self.config.plant,)
        if imitation.rounds and imitation.batched and not all(map(is_possible, plants)):
            raise ConfigError(
                "imitation.batched: true is not valid for a fish of another model, with another "
                "servo_law than tanh or with quadratic drag; false is needed"
            )

    @property
    def is_begun(self) -> bool:
        """True if the training begins with the networks of an earlier one."""
        return self.resume or self.parent is not None

    @property
    def cleans_rewards(self) -> bool:
        """True if the sensor's drift and turn are removed; one episode of a fish is too short."""
        one_fish = self.on == "live" or self.settings.randomisation == Randomisation()
        return self.settings.ppo.clean_rewards and one_fish

    def last_step(self, done: int = 0) -> int:
        """Return the last step: PPO learns from whole rollouts; done: steps done already."""
        rollout = self.settings.ppo.n_steps
        return done + math.ceil((self.settings.steps - done) / rollout) * rollout


class Outcome(Struct, frozen=True, kw_only=True):
    """The outcome of a training."""

    folder: Path
    steps: int = 0
    """Number of control steps learned from."""
    dropped: int = 0
    """Number of steps of a rollout that was stopped midway, not used for learning."""
    tank_time: float = 0.0
    """Time in the tank [s]."""
    ended: Ended
    """Reason of the end; failed: one of several seeds raised an exception."""
    message: str = ""
    """Explanation, where the training neither did all steps nor was interrupted by the user."""
    checkpoint: Path | None = None
    """Newest checkpoint."""
    best: Path | None = None
    """Checkpoint of `best_evaluation`."""
    latest_evaluation: Evaluation | None = None
    best_evaluation: Evaluation | None = None
