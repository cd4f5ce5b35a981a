"""The link to a running fishd, real or simulated, by its controller `remote`."""

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
from fishd.learning.links.link import LinkLost, StepResult

OBSERVATION_TIMEOUT_S = 10.0
"""Time without an observation after which control counts as lost [s]."""
FRAMES_TIMEOUT_S = 5.0
"""Time without frames after which the camera counts as lost [s]; a restart takes less."""
STATUS_INTERVAL_S = 1.0
"""Time without an observation after which the status of fishd is requested [s]."""


def config_of(endpoint: str | None) -> dict[str, Any]:
    """Return the configuration of a running fishd, for `adopt`; raises `FishError`."""
    with Fish(endpoint) as fish:
        return fish.config()


def plant_differences(config: Config, theirs: dict[str, Any]) -> str:
    """Return the differences of the plant of a configuration from that of fishd; empty if none."""
    ours: dict[str, Any] = msgspec.to_builtins(config.plant)
    return ", ".join(
        f"plant.{key} is {value!r} here, {theirs.get(key)!r} there"
        for key, value in ours.items()
        if theirs.get(key) != value
    )


class FishdLink:
    """The link to a fishd: makes `remote` its active controller, and is the agent of it.

    With `lockstep: true` and `start.controller: remote` fishd waits for its agent from its first
    tick on; then all results equal those of a `SimulatedLink`, bit by bit.
    """

    config: Config | None
    """None: the parameters of the fish are not known."""

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
        experiment: name of the lease, as `fishctl status` shows it
        take: whether to take the fish from an experiment that holds it
        address: address at which fishd reaches this program, as for `Agent`; None: the address at
            which fishd waits for an agent, else any free port of this machine
        deadline: time that a tick waits for an action [s]; None for the default of fishd
        stack: frames of the camera that an observation needs; None without a camera
        camera: request address of the camera; None: as for `CameraClient`

        Raises `NoDaemon` when no fishd answers, `Refused` while fishd is in mode fault or estop or
        another experiment holds the fish, `CameraLost` when no camera answers, `PolicyError` where
        its frames do not suit `stack`, and `FishError` when the address cannot be bound.
        """
        self._fish = Fish(endpoint)
        self._sight: LiveSight | None = None
        self._experiment, self._lease = experiment, ExitStack()
        try:
            status = self._fish.status()
            if status.reason:
                raise Refused(status.mode, _format_fault(status.mode, status.reason))
            if stack:
                self._sight = LiveSight(camera, self._fish, stack)
                self._sight.await_frames()
            self._take_lease(take)
            self._agent = _make_agent(address, status)
        except BaseException:
            self._lease.close()
            self._close_sight()
            self._fish.close()
            raise
        self._deadline = deadline
        self._begun = self._paused = self._closed = False
        self._acquired = status
        """Status of fishd when control was acquired."""
        self._stack_time = time.monotonic()
        """Time of the latest whole stack of frames [s, monotonic]."""
        self._received = 0.0
        """Time at which the latest observation arrived [s, monotonic]."""
        self.tick = status.tick
        self.amplitude = status.amplitude_limit
        self.config = None

    def reset(self, seed: int = 0, new: bool = False) -> Observation:
        """Return the observation that the next action answers; the fish swims on from its state.

        Makes `remote` the active controller, unless fishd waits for this agent already. Another
        controller is replaced only the first time. Raises `LinkLost`; once fishd is idle, another
        reset acquires control again.
        """
        self._check_open()
        self._stack_time = time.monotonic()
        if self._paused and self._agent.active:
            return self.resume()
        if self._begun and self._is_fresh():
            return self._pending()
        self._paused = False
        try:
            status = self._fish.status()
            if not self._is_ours(status):
                if self._begun and status.mode == "running":
                    raise LinkLost(f"{self._lost_error(status)}; 'fishctl stop' frees the fish")
                self._take_lease()
                self._fish.set_controller(
                    "remote", agent=self._agent.address, deadline=self._deadline
                )
                self._agent.active = False
            elif self._agent.latest and (self._agent.poll(STATUS_INTERVAL_S) or self._agent.active):
                self._begun, self._acquired, self._received = True, status, time.monotonic()
                return self._agent.latest  # in lockstep, fishd still waits for its answer
        except (NoDaemon, Refused) as error:
            raise LinkLost(str(error)) from None
        self._begun, self._acquired = True, status
        return self._await_next(begun=False)

    def step(self, angle: float) -> StepResult:
        """Answer the latest observation, and return the next one; raises `LinkLost`."""
        observed = self._pending()
        self._agent.act(angle)
        following = self._await_next()
        # The agent does not count a tick of a pause as lost, but its action was not applied.
        applied = following.answered_seq == observed.seq
        return StepResult(following, max(self._agent.lost, 0 if applied else 1))

    def look(self) -> Stack | None:
        """Return the frames for the latest observation; in lockstep, wait for them.

        After `FRAMES_TIMEOUT_S` without frames, raise `LinkLost`, with the fish at neutral.
        """
        if self._sight is None:
            return None
        try:
            stack = self._sight.look(self._pending().time)
        except (CameraLost, PolicyError) as error:
            raise LinkLost(str(error)) from None
        now = time.monotonic()
        if stack is not None:
            self._stack_time = now
        elif now - self._stack_time > FRAMES_TIMEOUT_S:
            self.pause(OBSERVATION_TIMEOUT_S)  # to find the cause takes longer than fishd waits
            raise LinkLost(str(self._sight.lost()))
        return stack

    def pause(self, seconds: float) -> None:
        """Hold the fish at neutral for `seconds` at most; in lockstep, its time stands still."""
        self._pending()
        self._agent.pause(min(seconds, 3600.0))
        self._paused = True

    def resume(self) -> Observation:
        """End the pause, and return the next observation. Raises `LinkLost`."""
        self._stack_time = time.monotonic()
        self._paused = False
        self._pending()
        self._agent.resume()
        return self._await_next()

    def close(self) -> None:
        """Leave the fish at neutral, where this agent still controls it; may be called twice."""
        if self._closed:
            return
        self._closed = True
        if self._begun:
            with contextlib.suppress(FishError):
                if self._agent.active and self._agent.latest:
                    self._agent.pause(
                        OBSERVATION_TIMEOUT_S
                    )  # the rest may take longer than fishd waits
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

    def _pending(self) -> Observed:
        """Return the observation to be answered; raises `LinkLost`."""
        self._check_open()
        if self._agent.latest is None or not self._agent.active:
            raise self._lost_error()
        return self._agent.latest

    def _is_fresh(self) -> bool:
        """Return whether fishd probably still waits for the answer to the latest observation."""
        if self._agent.poll():
            self._received = time.monotonic()
        return self._agent.active and time.monotonic() - self._received < STATUS_INTERVAL_S

    def _await_next(self, *, begun: bool = True) -> Observed:
        """Return the next observation; begun: whether it must be of the same session."""
        before = self._agent.latest
        deadline = time.monotonic() + OBSERVATION_TIMEOUT_S
        while time.monotonic() < deadline:
            observed = self._agent.poll(STATUS_INTERVAL_S)
            if observed:
                self._received = time.monotonic()
            if observed and begun and before and observed.session != before.session:
                raise LinkLost(
                    "fishd has begun a new session with this agent: perhaps it was restarted"
                )
            if observed:
                return observed
            if begun and not self._agent.active:
                break
            self._check_agent()
        raise self._lost_error()

    def _check_agent(self) -> None:
        """Raise `LinkLost` unless this is the agent of the controller `remote` of fishd."""
        try:
            status = self._fish.status()
        except NoDaemon as error:
            self._agent.active = False
            raise LinkLost(str(error)) from None
        if not self._is_ours(status):
            raise self._lost_error(status)

    def _is_ours(self, status: Status) -> bool:
        """Return whether fishd uses, or waits for, this agent."""
        return _waits_for_an_agent(status) and (
            (self._agent.active and not status.shows_restart_since(self._acquired))
            or status.parameters["agent"] == self._agent.address
        )

    def _lost_error(self, status: Status | None = None) -> LinkLost:
        """Return the error of a lost control, with the reason that fishd gives if it gives one."""
        self._agent.active = False
        try:
            status = status or self._fish.status()
        except NoDaemon as error:
            return LinkLost(str(error))
        if status.shows_restart_since(self._acquired):
            return LinkLost(
                f"fishd was restarted: it is process {status.pid} now, and was {self._acquired.pid}"
            )
        if status.reason:
            return LinkLost(_format_fault(status.mode, status.reason))
        if self._is_ours(status):
            return LinkLost(
                f"fishd at {self._fish.endpoint} has sent no observation to {self._agent.address} "
                f"within {OBSERVATION_TIMEOUT_S:g} s"
            )
        if _waits_for_an_agent(status):
            return LinkLost(f"another agent has taken command: {status.parameters['agent']}")
        if status.mode == "running":
            return LinkLost(f"another controller has taken command: {status.controller}")
        if status.lease_expiry:
            return LinkLost(status.lease_expiry.message)
        return LinkLost("fishd received a request to stop")


def _format_fault(mode: str, reason: Reason) -> str:
    return (
        f"fishd is in mode {mode}: {reason.message}; when that is mended, leave it with 'fishctl "
        "clear-fault'"
    )


def _waits_for_an_agent(status: Status) -> bool:
    return status.mode == "running" and status.controller == "remote"


def _make_agent(address: str | None, status: Status) -> Agent:
    if address is not None:
        return Agent(address)
    if _waits_for_an_agent(status):
        with contextlib.suppress(FishError):  # the address is in use, or on another machine
            return Agent(status.parameters["agent"])
    return Agent()
