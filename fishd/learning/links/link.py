"""The interface between the environment and the fish: simulated in this process, or of a fishd.

One step of an agent: it sends an instruction angle, one tick passes, it receives an observation.
"""

from typing import NamedTuple, Protocol

from fishd.config import Config
from fishd.core.camera_frames import Stack
from fishd.core.errors import FishdError
from fishd.core.signals import Observation


class LinkLost(FishdError, ConnectionError):
    """Error of an agent that no longer controls the fish; the message says why."""


class StepResult(NamedTuple):
    """The result of one step."""

    observation: Observation
    lost: int = 0
    """Number of ticks since the previous observation with another angle than the action."""


class Link(Protocol):
    """A connection of the agent to the fish that it controls."""

    tick: float
    """Period of the loop [s]."""
    amplitude: float
    """Amplitude limit Φ [rad]."""

    @property
    def config(self) -> Config | None:
        """Configuration of the fish that swims now; None if unknown."""

    def reset(self, seed: int = 0, new: bool = False) -> Observation:
        """Acquire control if necessary; return the observation that the next action answers.

        seed: seed of the noise and of the parameters of a new fish
        new: start a new fish at rest, if it is simulated; a real fish swims on

        Raises `LinkLost`.
        """

    def step(self, angle: float) -> StepResult:
        """Apply an instruction angle [rad] for one tick; raises `LinkLost`."""

    def look(self) -> Stack | None:
        """Return the frames for the latest observation; to be called once a tick.

        None without a camera, and if the camera has not delivered them yet.
        """

    def pause(self, seconds: float) -> None:
        """Hold the fish at neutral while the agent learns, for `seconds` at most.

        Raises `LinkLost`.

        In simulation, virtual time stands still instead.
        """

    def resume(self) -> Observation:
        """End the pause; return the observation that the next action answers. Raises `LinkLost`."""

    def close(self) -> None:
        """Leave the fish at neutral; may be called twice."""
