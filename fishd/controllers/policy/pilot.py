"""A policy outside of fishd's loop: observation in, instruction angle out.

For `fishctl agent` and for comparisons; within the loop, the controller `ppo` does the same.
"""

import math

from fishd.controllers.base import Limits
from fishd.controllers.dwell import DwellLimit
from fishd.controllers.policy import opening
from fishd.controllers.policy.card import History
from fishd.controllers.policy.runtime import Network
from fishd.core.camera_frames import Stack
from fishd.core.errors import PolicyError
from fishd.core.signals import Observation

HOLD_TIME_S = 0.25
"""Time for which the last angle is held without frames; then, and before the first frame, the angle
is neutral [s]. Half a beat of the default fish lasts 0.3 s, so a longer hold is not swimming."""


class Pilot:
    """Runner of a policy file, tick by tick, for one fish."""

    def __init__(self, policy: str, limits: Limits) -> None:
        """
        policy: name or path
        limits: limits of the robot, including the shortest time between two reversals

        Raises `PolicyError` for a policy that does not fit, or does not run here.
        """
        policy_file = opening.read(policy, limits)
        self.card = policy_file.card
        self._network = Network(policy_file)
        self._history = History(self.card.observation, self.card.window, self._network.row)
        self._limit = DwellLimit(limits.dwell, limits, self.card.amplitude)
        self._angle = 0.0
        self._begun = False
        self.blind = 0.0
        """Time since the last frames [s]."""

    @property
    def waits(self) -> bool:
        """Whether it is at neutral because frames are missing."""
        return self.blind > HOLD_TIME_S

    def angle(self, observation: Observation, stack: Stack | None = None) -> float:
        """Return the angle for an observation [rad].

        stack: frames; None if they are incomplete

        Raise `ControllerFault` with the code `chatter`, see `DwellLimit`, and `PolicyError` for
        frames of another size and for an output that is not finite.
        """
        if not self._begun:
            self._begun = True
            self._limit.activate(observation.instruction_angle)
        self._history.push(observation)
        if self.card.pictures and stack is None:
            self.blind += observation.dt
            angle = 0.0 if self.waits else self._angle
        else:
            self.blind = 0.0
            angle = self._chosen(observation, stack)
        self._angle = self._limit.apply(angle, observation.dt)
        return self._angle

    def _chosen(self, observation: Observation, stack: Stack | None) -> float:
        network = self._network
        if self.card.pictures and stack is not None:
            self._show(stack)
        action = network.run()
        if not math.isfinite(action):
            raise PolicyError(f"the output of the policy is not finite: {action}")
        return self.card.amplitude * max(-1.0, min(1.0, action))

    def _show(self, stack: Stack) -> None:
        places = self._network.frames
        sizes = [frame.shape for frame in stack]
        if sizes != [place.shape for place in places]:
            count, height, width = places.shape
            raise PolicyError(
                f"it needs {count} frames of {height} x {width} pixels, but got frames of {sizes}"
            )
        for place, frame in zip(places, stack, strict=True):
            place[:] = frame
