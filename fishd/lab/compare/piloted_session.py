"""A live fish on which policies that see pictures swim, too: this program is their agent."""

import threading
from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any

from msgspec.structs import replace

from fishd.camera.live_sight import LiveSight
from fishd.client import Agent, Fish
from fishd.controllers.base import Limits
from fishd.controllers.policy.pilot import Pilot
from fishd.core.errors import FishdError, PolicyError
from fishd.core.signals import Tick
from fishd.lab.compare.seeing import sees_pictures
from fishd.lab.session import Disturbed, LiveSession

GIVE_UP = 2.0
"""After so long without frames the camera counts as lost [s]."""
_REST = 60.0
"""Longest rest after that, in which fishd expects no answer [s]."""
_PATIENCE = 0.1
"""How long an agent waits for an observation before it looks whether it is to end [s]."""


class PilotedSession(LiveSession):
    """As `LiveSession`; a policy that sees pictures swims as the agent of fishd's `remote`."""

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
        experiment, take: as for `LiveSession`
        camera: where fishd-camera takes requests; None: as for `CameraClient`
        agent: where fishd reaches this program; None: any free port, for a fishd on this machine

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
        """As `LiveSession.swim`; raises `PolicyError` for a policy that does not suit the camera.

        Raises `CameraLost` where there is no camera, and `Disturbed` where it is lost.
        """
        policy = parameters.get("policy")
        if controller != "ppo" or not sees_pictures(policy, self._limits):
            return super()._swim(controller, parameters, seconds)
        agent = self._agent_of(str(policy))
        dwell = self._limits.dwell
        asked = {"agent": agent.address, "dwell": dwell}
        try:
            found = super()._swim("remote", asked, seconds)
        except Disturbed:
            if agent.problem:
                raise Disturbed(f"{policy}: {agent.problem}") from None
            raise
        if agent.problem:
            raise Disturbed(f"{policy}: {agent.problem}: this measurement is lost")
        return found

    def _agent_of(self, policy: str) -> "_PilotThread":
        """The agent that swims a policy; only the latest one is kept."""
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
    """Answers each observation that fishd sends with what a policy chooses, in its own thread."""

    def __init__(
        self, policy: str, limits: Limits, endpoint: str, camera: str | None, address: str | None
    ) -> None:
        """Raises `PolicyError`, `CameraLost` and `FishError`; answers from then on."""
        self.problem: FishdError | None = None
        """Why the fish is kept at neutral, if it is."""
        # fishd itself holds back reversals that come too soon, as it does for ppo.
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
        """End; fishd must not wait for it any more."""
        self._stopping.set()
        self._thread.join()
        self._stack.close()

    def _run(self) -> None:
        agent = self._agent
        while not self._stopping.is_set():
            seen = agent.poll(_PATIENCE)
            try:
                if seen is None:
                    self._sight.listen()
                elif self.problem:
                    agent.act(0.0)
                else:
                    agent.act(self._pilot.angle(seen, self._sight.look(seen.time)))
                    if self._pilot.blind > GIVE_UP:
                        agent.pause(_REST)  # at neutral: to find out why takes a while
                        self.problem = self._sight.lost()
            except FishdError as error:
                self.problem = error
                if seen:
                    agent.act(0.0)
