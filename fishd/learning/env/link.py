"""The interface between the environment and the fish: simulated in this process, or of a fishd.

One step of an agent: it sends an instruction angle, one tick passes, it receives an observation.
"""

from typing import NamedTuple, Protocol

from fishd.config import Config
from fishd.core.camera_frames import Stack
from fishd.core.errors import FishdError
from fishd.core.signals import Observation


class LinkLost(FishdError, ConnectionError):
    """The fish is gone, or the agent no longer controls it; the message says why."""


class StepResult(NamedTuple):
    """What came of one step."""

    observation: Observation
    lost: int = 0
    """Ticks since the previous observation in which another angle than the action was applied."""
    power: float | None = None
    """Mean electrical power of the servo since then [W]; None where it is not known."""


class Link(Protocol):
    """One fish, and the agent that controls it."""

    tick: float
    """Period of the loop [s]."""
    amplitude: float
    """Φ [rad]"""

    @property
    def config(self) -> Config | None:
        """The fish that swims now, where that is known."""

    def reset(self, seed: int = 0, new: bool = False) -> Observation:
        """Acquire control, if it is not held yet; the observation that the next action answers.

        seed: of the noise and of the parameters, where a new fish begins
        new: begin with a new fish at rest, where that is possible; a real one swims on

        Raises `LinkLost`.
        """

    def step(self, angle: float) -> StepResult:
        """Apply an instruction angle [rad] for one tick; raises `LinkLost`."""

    def look(self) -> Stack | None:
        """The frames for the latest observation.

        None if the camera has not shown them yet, and without a camera; to be asked once a tick.
        """

    def pause(self, seconds: float) -> None:
        """Stay at neutral while the agent learns, for `seconds` at most; raises `LinkLost`.

        Virtual time stands still instead.
        """

    def resume(self) -> Observation:
        """End the pause; the observation that the next action answers. Raises `LinkLost`."""

    def close(self) -> None:
        """Leave the fish at neutral; may be called twice."""
