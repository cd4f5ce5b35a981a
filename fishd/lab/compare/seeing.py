"""Policies that see pictures, on a simulated fish with a simulated camera."""

from typing import Any

from fishd.camera.simulated import SimulatedCameraSettings, SimulatedSight
from fishd.controllers.base import Controller, Limits
from fishd.controllers.policy import file, library, opening
from fishd.controllers.policy.controller import PpoParameters
from fishd.controllers.policy.pilot import Pilot
from fishd.core.errors import PolicyError
from fishd.core.signals import Observation
from fishd.lab.simulation import VirtualRun


def sees_pictures(policy: Any, limits: Limits) -> bool:
    """Return whether a policy sees pictures; False for one that does not fit, which `ppo` rejects.

    policy: name or path of the policy
    """
    try:
        return isinstance(policy, str) and opening.read(policy, limits).card.pictures is not None
    except PolicyError:
        return False


def may_see_pictures(policy: Any) -> bool:
    """Return whether a policy sees pictures or cannot be read here.

    policy: name or path of the policy
    """
    try:
        return isinstance(policy, str) and file.read(library.find(policy)).card.pictures is not None
    except PolicyError:
        return True


class SeeingController(Controller[PpoParameters]):
    """The controller `ppo` for a policy that sees pictures, with a simulated camera."""

    Parameters = PpoParameters

    def __init__(
        self, parameters: PpoParameters, limits: Limits, camera: SimulatedCameraSettings
    ) -> None:
        """Raises `PolicyError`."""
        super().__init__(parameters, limits)
        self._pilot = Pilot(parameters.policy, limits)
        self._camera = camera
        self._sight: SimulatedSight | None = None

    def watch(self, run: VirtualRun) -> None:
        """Connect the simulated camera to the fish of a run, before its first tick."""
        truth, pictures = run.loop.robot.truth, self._pilot.card.pictures
        assert truth
        assert pictures
        self._sight = SimulatedSight(self._camera, pictures, self.limits.tick, truth)

    def update(self, observation: Observation) -> float:
        """Return the angle of the policy [rad]; raises `ControllerFault`, see `DwellLimit`."""
        stack = self._sight.look(observation.time) if self._sight else None
        return self._pilot.angle(observation, stack)
