"""The seam between the environment and whatever swims: a fish in this process, or a running fishd.

An agent's step is: an instruction angle goes out, one tick passes, an observation comes back.
"""

from typing import NamedTuple, Protocol

from fishd.errors import FishdError
from fishd.signals import Observation


class LinkLost(FishdError, ConnectionError):
    """What swims is gone, or has left the agent's command; the message says why."""


class Sensed(NamedTuple):
    """What came back from a tick."""

    observation: Observation
    lost: int = 0
    """Ticks since the one before in which something else than the agent's action was in force."""


class Link(Protocol):
    """One fish, and the agent in command of it."""

    tick: float
    """Period of the loop [s]."""
    amplitude: float
    """Φ [rad]"""
    restartable: bool
    """Can there be a new fish? One that is real, or swims in another process, can only go on."""
    varies: bool
    """Does a new fish differ from the one before?"""

    def start(self) -> Observation:
        """Take command, if it is not taken yet; the observation that the next action answers."""

    def restart(self, seed: int) -> Observation:
        """A new fish at rest, its noise and its parameters drawn with `seed`.

        Raises RuntimeError where the link is not `restartable`.
        """

    def step(self, angle: float) -> Sensed:
        """Put an instruction angle [rad] in force for a tick; raises `LinkLost`."""

    def pause(self, seconds: float) -> None:
        """Stay at neutral while the agent thinks, for `seconds` at most; raises `LinkLost`.

        Virtual time stands still instead.
        """

    def resume(self) -> Observation:
        """End the pause; the observation that the next action answers. Raises `LinkLost`."""

    def close(self) -> None:
        """Leave the fish at neutral; may be called twice."""
