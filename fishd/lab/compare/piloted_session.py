"""A session on a live fish that also swims policies with pictures, with this program as agent."""

import threading
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

from msgspec.structs import replace

from fishd.camera.live_sight import LiveSight
from fishd.client import Agent, Fish
from fishd.controllers.base import Limits
from fishd.controllers.policy.runtime import Pilot
from fishd.core.errors import FishdError, PolicyError
from fishd.core.signals import Tick
from fishd.lab.compare.contestants import sees_pictures
from fishd.lab.session import Disturbed, LiveSession

CAMERA_TIMEOUT_S = 2.0
"""Time without frames after which the camera counts as lost [s]."""
_PAUSE_S = 60.0
"""Longest pause of the agent after that, in which fishd expects no answer [s]."""
_POLL_TIMEOUT_S = 0.1
"""Timeout of a wait for an observation, after which the agent checks whether to end [s]."""


class PilotedSession(LiveSession):
    """A `LiveSession` in which a policy that sees pictures is the agent of fishd's `remote`."""

    def __init__(
        self,
        fish: Fish,
        experiment: str = "experiment",
        take: bool = False,
        *,
        camera: str | None = None,
        agent: str | None = None,
    ) -> None:
        """
        experiment, take: see `LiveSession`
        camera: endpoint of the requests of fishd-camera; None for the default of `CameraClient`
        agent: address of this program for fishd; None for a free port, for a fishd on this machine

        Raises `FishError`.
        """
        super().__init__(fish, experiment, take)
        self._endpoint, self._camera, self._address = fish.endpoint, camera, agent
        self._limits = self.read_config().limits
        self._stack = ExitStack()
        self._policy = ""
        self._agent: _PilotThread

    def __exit__(self, *exception: Any) -> None:
        super().__exit__(*exception)
        self._stack.close()

    def _swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        """Implement `swim`; raise `PolicyError` for a policy that does not fit the camera.

        Raises `CameraLost` without a camera, and `Disturbed` where it is lost during the swim.
        """
        policy = parameters.get("policy")
        if controller != "ppo" or not sees_pictures(policy, self._limits):
            return super()._swim(controller, parameters, seconds)
        agent = self._agent_of(str(policy))
        dwell = self._limits.dwell
        remote_parameters = {"agent": agent.address, "dwell": dwell}
        try:
            ticks = super()._swim("remote", remote_parameters, seconds)
        except Disturbed:
            if agent.problem:
                raise Disturbed(f"{policy}: {agent.problem}") from None
            raise
        if agent.problem:
            raise Disturbed(f"{policy}: {agent.problem}: this measurement is lost")
        return ticks

    def _agent_of(self, policy: str) -> "_PilotThread":
        """Return the agent that swims a policy; close the one of another policy."""
        if policy != self._policy:
            self._stack.close()
            self._policy = ""
            self._agent = _PilotThread(
                policy, self._limits, self._endpoint, self._camera, self._address
            )
            self._stack.callback(self._agent.close)
            self._policy = policy
        return self._agent


class _PilotThread:
    """An agent that answers the observations of fishd with the actions of a policy, in a thread."""

    def __init__(
        self, policy: str, limits: Limits, endpoint: str, camera: str | None, address: str | None
    ) -> None:
        """Start answering; raises `PolicyError`, `CameraLost` and `FishError`."""
        self.problem: FishdError | None = None
        """Error because of which the fish is kept at neutral; None if there is none."""
        # fishd itself delays reversals that come too soon, as it does for ppo.
        free = replace(limits, dwell=0.0)
        with ExitStack() as stack:
            self._pilot = Pilot(policy, free)
            pictures = self._pilot.card.pictures
            if pictures is None:
                raise PolicyError(f"{policy}: it sees no pictures")
            fish = stack.enter_context(Fish(endpoint))
            self._sight = stack.enter_context(LiveSight(camera, fish, pictures))
            self._sight.await_frames()
            arguments = (address,) if address else ()
            self._agent = stack.enter_context(Agent(*arguments, timeout=None))
            self._stack = stack.pop_all()
        self.address = self._agent.address
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pilot", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop the thread; fishd must not wait for an answer any more."""
        self._stopping.set()
        self._thread.join()
        self._stack.close()

    def _run(self) -> None:
        agent = self._agent
        while not self._stopping.is_set():
            observation = agent.poll(_POLL_TIMEOUT_S)
            try:
                if observation is None:
                    self._sight.listen()
                elif self.problem:
                    agent.act(0.0)
                else:
                    agent.act(self._pilot.angle(observation, self._sight.look(observation.time)))
                    if self._pilot.blind > CAMERA_TIMEOUT_S:
                        agent.pause(_PAUSE_S)  # at neutral, as the diagnosis takes a while
                        self.problem = self._sight.lost()
            except FishdError as error:
                self.problem = error
                if observation:
                    agent.act(0.0)
