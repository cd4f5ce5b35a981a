"""The link to a running fishd, on the robot or with a simulated fish: its controller `remote`."""

import contextlib
import time
from contextlib import ExitStack
from typing import Any

import msgspec

from fishd.camera.client import CameraLost
from fishd.camera.live_sight import LiveSight
from fishd.client import Fish
from fishd.client.agent import Agent
from fishd.config import Config
from fishd.core.agent_messages import Observed
from fishd.core.camera_frames import Stack, StackSettings
from fishd.core.errors import FishError, LeaseLost, NoDaemon, PolicyError, Refused
from fishd.core.signals import Observation, Reason, Status
from fishd.learning.env.link import LinkLost, StepResult

PATIENCE = 10.0
"""How long the fish may take to begin, or to go on [s]."""
GIVE_UP = 5.0
"""After so long without frames the camera counts as lost [s]; one that is restarted is back."""
SILENCE = 1.0
"""After so long without an observation, fishd is asked for its status [s]."""


def config_of(endpoint: str | None) -> dict[str, Any]:
    """The configuration of a running fishd, for `adopt`; raises `FishError`."""
    with Fish(endpoint) as fish:
        return fish.config()


def other_plant(config: Config, theirs: dict[str, Any]) -> str:
    """How the plant of a configuration differs from that of fishd; empty where it does not."""
    ours: dict[str, Any] = msgspec.to_builtins(config.plant)
    return ", ".join(
        f"plant.{key} is {value!r} here, {theirs.get(key)!r} there"
        for key, value in ours.items()
        if theirs.get(key) != value
    )


class FishdLink:
    """Makes `remote` the active controller of a fishd, and is its agent.

    With `lockstep: true` and `start.controller: remote` fishd waits for its agent from its first
    tick on: then all numbers are those of a `SimulatedLink`, bit by bit.
    """

    config: Config | None
    """None: which fish swims is not known."""

    def __init__(
        self,
        endpoint: str | None = None,
        experiment: str = "agent",
        take: bool = False,
        *,
        address: str | None = None,
        deadline: float | None = None,
        stack: StackSettings | None = None,
        camera: str | None = None,
    ) -> None:
        """
        endpoint: control socket of the fishd; None looks for that of this machine
        experiment: what the lease of the fish is called, as `fishctl status` shows it
        take: take the fish from an experiment that holds it
        address: where that fishd can reach this program, as for `Agent`; None: where fishd waits
            for an agent already, else any free port of this machine
        deadline: how long a tick waits for an action [s]; None for fishd's default
        stack: which frames of a camera are wanted; None: none
        camera: where that camera takes requests; None: as for `CameraClient`

        Raises `NoDaemon` when no fishd answers, `Refused` while it is in mode fault or estop or
        another experiment holds the fish, `CameraLost` when no camera answers, `PolicyError` where
        its frames do not suit `stack`, and `FishError` when the address cannot be bound.
        """
        self._fish = Fish(endpoint)
        self._sight: LiveSight | None = None
        self._experiment, self._lease = experiment, ExitStack()
        try:
            status = self._fish.status()
            if status.reason:
                raise Refused(status.mode, _fault(status.mode, status.reason))
            if stack:
                self._sight = LiveSight(camera, self._fish, stack)
                self._sight.await_frames()
            self._take_lease(take)
            self._agent = _agent(address, status)
        except BaseException:
            self._lease.close()
            self._close_sight()
            self._fish.close()
            raise
        self._deadline = deadline
        self._begun = self._paused = self._closed = False
        self._known = status
        """Status of fishd when control was acquired."""
        self._seen = time.monotonic()
        """When the camera last showed a whole stack [s, monotonic]."""
        self._taken = 0.0
        """When the latest observation came [s, monotonic]."""
        self.tick = status.tick
        self.amplitude = status.amplitude_limit
        self.config = None

    def reset(self, seed: int = 0, new: bool = False) -> Observation:
        """The observation that the next action answers; the fish swims on from where it is.

        Makes `remote` the active controller where fishd does not wait for this agent already; only
        the first time is it taken from another controller. Raises `LinkLost`; once fishd is idle,
        another reset begins anew.
        """
        self._check_open()
        self._seen = time.monotonic()
        if self._paused and self._agent.active:
            return self.resume()
        if self._begun and self._is_fresh():
            return self._asked()
        self._paused = False
        try:
            status = self._fish.status()
            if not self._is_ours(status):
                if self._begun and status.mode == "running":
                    raise LinkLost(f"{self._lost(status)}; 'fishctl stop' frees the fish")
                self._take_lease()
                self._fish.set_controller(
                    "remote", agent=self._agent.address, deadline=self._deadline
                )
                self._agent.active = False
            elif self._agent.latest and (self._agent.poll(SILENCE) or self._agent.active):
                self._begun, self._known, self._taken = True, status, time.monotonic()
                return self._agent.latest  # for which fishd still waits, in lockstep
        except (NoDaemon, Refused) as error:
            raise LinkLost(str(error)) from None
        self._begun, self._known = True, status
        return self._next(begun=False)

    def step(self, angle: float) -> StepResult:
        """Answer the latest observation, and wait for the next one; raises `LinkLost`."""
        asked = self._asked()
        self._agent.act(angle)
        found = self._next()
        # A tick of a pause is not counted as lost there, but no action was applied in it either.
        applied = found.answered == asked.seq
        return StepResult(found, max(self._agent.lost, 0 if applied else 1))

    def look(self) -> Stack | None:
        """What the camera shows; in lockstep, once it has come so far.

        After `GIVE_UP` without, it raises `LinkLost`, with the fish at neutral.
        """
        if self._sight is None:
            return None
        try:
            stack = self._sight.look(self._asked().time)
        except (CameraLost, PolicyError) as error:
            raise LinkLost(str(error)) from None
        now = time.monotonic()
        if stack is not None:
            self._seen = now
        elif now - self._seen > GIVE_UP:
            self.pause(PATIENCE)  # to find out why takes longer than fishd waits
            raise LinkLost(str(self._sight.lost()))
        return stack

    def pause(self, seconds: float) -> None:
        """Let the fish wait at neutral, or stand still in lockstep, for `seconds` at most."""
        self._asked()
        self._agent.pause(min(seconds, 3600.0))
        self._paused = True

    def resume(self) -> Observation:
        """End the pause; an observation from after it. Raises `LinkLost`."""
        self._seen = time.monotonic()
        self._paused = False
        self._asked()
        self._agent.resume()
        return self._next()

    def close(self) -> None:
        """Leave the fish at neutral, where this agent still controls it; may be called twice."""
        if self._closed:
            return
        self._closed = True
        if self._begun:
            with contextlib.suppress(FishError):
                if self._agent.active and self._agent.latest:
                    self._agent.pause(PATIENCE)  # what follows may take longer than fishd waits
                if self._is_ours(self._fish.status()):
                    self._fish.stop()
        self._lease.close()
        self._agent.close()
        self._close_sight()
        self._fish.close()

    def _take_lease(self, take: bool = False) -> None:
        """Take the lease of the fish, unless this link has it; raises `Refused` and `NoDaemon`."""
        if self._fish.held:
            try:
                self._fish.renew_lease(self._fish.held.token)
                return
            except LeaseLost:
                self._lease.close()
        self._lease.enter_context(self._fish.lease(self._experiment, take=take, idle_limit=None))

    def _close_sight(self) -> None:
        if self._sight:
            self._sight.close()

    def _check_open(self) -> None:
        if self._closed:
            raise LinkLost("this link to fishd is closed; make another one")

    def _asked(self) -> Observed:
        """The observation to be answered, while this agent controls the fish."""
        self._check_open()
        if self._agent.latest is None or not self._agent.active:
            raise self._lost()
        return self._agent.latest

    def _is_fresh(self) -> bool:
        """Does fishd still wait for the answer to the latest observation, as far as is known?"""
        if self._agent.poll():
            self._taken = time.monotonic()
        return self._agent.active and time.monotonic() - self._taken < SILENCE

    def _next(self, *, begun: bool = True) -> Observed:
        """The next observation, of the same session if one had begun."""
        before = self._agent.latest
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            found = self._agent.poll(SILENCE)
            if found:
                self._taken = time.monotonic()
            if found and begun and before and found.session != before.session:
                raise LinkLost(
                    "fishd has begun a new session with this agent: perhaps it was restarted"
                )
            if found:
                return found
            if begun and not self._agent.active:
                break
            self._check()
        raise self._lost()

    def _check(self) -> None:
        """Raises `LinkLost` where fishd says that this agent is not the one of its `remote`."""
        try:
            status = self._fish.status()
        except NoDaemon as error:
            self._agent.active = False
            raise LinkLost(str(error)) from None
        if not self._is_ours(status):
            raise self._lost(status)

    def _is_ours(self, status: Status) -> bool:
        """Is this the agent that fishd asks, or waits for?"""
        return _waits_for_an_agent(status) and (
            (self._agent.active and not self._is_another(status))
            or status.parameters["agent"] == self._agent.address
        )

    def _is_another(self, status: Status) -> bool:
        """Is that another fishd than the one whose fish was controlled?"""
        known = self._known
        return status.pid != known.pid or status.uptime < known.uptime

    def _lost(self, status: Status | None = None) -> LinkLost:
        """Why control was lost, in fishd's own words where it says so."""
        self._agent.active = False
        try:
            status = status or self._fish.status()
        except NoDaemon as error:
            return LinkLost(str(error))
        if self._is_another(status):
            return LinkLost(
                f"fishd was restarted: it is process {status.pid} now, and was {self._known.pid}"
            )
        if status.reason:
            return LinkLost(_fault(status.mode, status.reason))
        if self._is_ours(status):
            return LinkLost(
                f"fishd at {self._fish.endpoint} has sent no observation to {self._agent.address} "
                f"within {PATIENCE:g} s"
            )
        if _waits_for_an_agent(status):
            return LinkLost(f"another agent has taken command: {status.parameters['agent']}")
        if status.mode == "running":
            return LinkLost(f"another controller has taken command: {status.controller}")
        if status.lease_expired:
            return LinkLost(status.lease_expired.message)
        return LinkLost("fishd was told to stop")


def _fault(mode: str, reason: Reason) -> str:
    return (
        f"fishd is in mode {mode}: {reason.message}; when that is mended, leave it with 'fishctl "
        "clear-fault'"
    )


def _waits_for_an_agent(status: Status) -> bool:
    return status.mode == "running" and status.controller == "remote"


def _agent(address: str | None, status: Status) -> Agent:
    if address is not None:
        return Agent(address)
    if _waits_for_an_agent(status):
        with contextlib.suppress(FishError):  # another agent is there, or that is another machine
            return Agent(status.parameters["agent"])
    return Agent()
