"""`remote`: an agent in another process chooses the instruction angle; docs/how-to/remote.md."""

import os
import time
from typing import Annotated, Any

from msgspec import Meta, Struct
from msgspec.structs import astuple

from fishd.controllers.base import MAX_DWELL_S, Controller, Limits
from fishd.controllers.dwell import DwellLimit
from fishd.controllers.quantities import quantity
from fishd.controllers.remote.wire import Wire
from fishd.core.addresses import find_connect_problem
from fishd.core.agent_messages import Ended, FromAgent, Observed, Pause, encode
from fishd.core.errors import ControllerFault, ParameterError
from fishd.core.schema import unit
from fishd.core.signals import Observation


class RemoteParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `remote`."""

    agent: Annotated[
        str,
        unit(
            "1",
            "ZeroMQ address that the agent has bound and that fishd connects to: tcp://HOST:PORT "
            "or ipc://PATH.",
            min_length=1,
            max_length=200,
        ),
    ] = "tcp://127.0.0.1:9873"
    deadline: Annotated[
        Annotated[float, Meta(gt=0, le=0.1)] | None,
        unit("s", "Time that each tick waits for the agent's action; null: 0.4 of the tick."),
    ] = None
    misses: Annotated[
        int,
        unit(
            "ticks",
            "Number of consecutive ticks without an action in time that is a fault.",
            ge=1,
            le=1000,
        ),
    ] = 5
    first_action: Annotated[
        float,
        unit(
            "s",
            "Maximum time until the first action of the agent; neutral until then.",
            gt=0,
            le=3600,
            usual=600,
        ),
    ] = 10.0
    dwell: Annotated[
        float,
        unit(
            "s",
            "Shortest time between two reversals, rounded up to whole ticks; earlier reversals "
            "are held back. 0 holds none back.",
            ge=0,
            le=MAX_DWELL_S,
        ),
    ] = 0.0


DEFAULT_DEADLINE_FRACTION = 0.4
"""Default time for the agent's action, as a fraction of the tick."""
MAX_DEADLINE_FRACTION = 0.45
"""Maximum time for the agent's action, as a fraction of the tick; a controller may take half a tick
in total, including its own computation."""
MAX_VIRTUAL_WAIT_S = 60.0
"""Maximum time that a run in virtual time waits for its agent, without pauses [s, real]."""
MAX_MESSAGES_AT_ONCE = 200
"""Maximum number of messages that are read between two checks of the time."""


class Remote(Controller[RemoteParameters]):
    """Let an agent choose: a program in another process, possibly on another machine.

    Each tick sends it the observation and waits for its action until the deadline. A tick without
    an action is neutral. An action applies only to the tick whose observation it answers. In
    virtual time a tick lasts until the agent has answered.
    """

    Parameters = RemoteParameters
    action: float | None = quantity("rad", "The agent's action; absent if none came in time.")
    silent: int = quantity("ticks", "Number of consecutive ticks without an action.")

    def __init__(self, parameters: RemoteParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        self._wire = Wire(parameters.agent)
        self._limit = DwellLimit(parameters.dwell, limits, limits.amplitude)
        self._session = os.urandom(8).hex()
        self._observation: Observation | None = None
        """Observation of the current tick."""
        self._question = b""
        self._unsent = False
        self._seq = 0
        self._open = 0
        """Number of the observation whose action is awaited; 0 for none."""
        self._asked_over = 0
        """Number of the connection over which that observation was sent."""
        self.action = None
        self._resting = False
        """Whether this tick is part of a pause."""
        self._pause = 0.0
        """Remaining time of the pause; in virtual time, its maximum duration [s]."""
        self._answered = 0
        self._lost = 0
        self._late = 0
        """Number of late answers since the latest one in time."""
        self._foreign = 0
        """Number of messages of another session since then."""
        self.silent = 0
        self._waited = 0.0
        """Time waited for the first action [s]."""
        self._problem: Exception | None = None

    @classmethod
    def check(cls, parameters: Any, limits: Limits) -> None:
        """Refuse an invalid address, and a deadline that is too long for the tick."""
        super().check(parameters, limits)
        complaint = find_connect_problem(parameters.agent)
        if complaint:
            raise ParameterError(
                f"agent: '{parameters.agent}' is not valid: {complaint}", ("agent",)
            )
        longest_deadline = MAX_DEADLINE_FRACTION * limits.tick
        if parameters.deadline is not None and parameters.deadline > longest_deadline:
            raise ParameterError(
                f"deadline: {parameters.deadline:g} s is not valid: at most {longest_deadline:g} "
                f"s, {MAX_DEADLINE_FRACTION:g} of a tick, as half a tick is all that a controller "
                "may take",
                ("deadline",),
            )

    def activate(self, observation: Observation) -> None:
        """Take over as if the tail had just reversed."""
        self._limit.activate(observation.instruction_angle)

    def retune(self, parameters: RemoteParameters) -> None:
        """Apply a new deadline or limit; a new agent needs a new activation."""
        if parameters.agent != self.parameters.agent:
            raise ParameterError(
                "agent: cannot be changed while remote is active; to change agents, use "
                f"'fishctl set-controller remote --agent {parameters.agent}'"
            )
        super().retune(parameters)
        self._limit.dwell = parameters.dwell

    def fileno(self) -> int:
        """Return a descriptor that is readable once the result of `ready` may have changed."""
        return self._wire.fileno()

    def ready(self, observation: Observation) -> bool:
        """Exchange messages without waiting; return True once `update` would return at once.

        Call it with the observation of the tick whenever the descriptor is readable.
        """
        try:
            if observation is not self._observation:
                self._begin(observation)
            self._exchange()
        except Exception as problem:  # raised by `update`, for which lockstep waits
            self._problem = problem
        return self._is_decided or self._problem is not None

    def update(self, observation: Observation) -> float:
        """Return the agent's action [rad], or 0 if none came in time.

        Raise `ControllerFault`: `remote-silent` after too many ticks without an action,
        `remote-error` for an invalid message, `chatter` for repeated reversals that are held back.
        """
        start = time.monotonic()
        while not self.ready(observation):
            remaining = start + self._patience - time.monotonic()
            if remaining <= 0.0:
                break
            self._wire.wait(remaining)
        if self._problem:
            raise self._problem
        return self._limit.apply(self._decide(observation), observation.dt)

    def close(self) -> None:
        """Notify the agent that `remote` is no longer active."""
        self._wire.close(encode(Ended(session=self._session)))

    @property
    def _patience(self) -> float:
        """Maximum time that a tick waits [s]."""
        if self.limits.virtual:
            return MAX_VIRTUAL_WAIT_S + self._pause
        deadline = self.parameters.deadline
        return DEFAULT_DEADLINE_FRACTION * self.limits.tick if deadline is None else deadline

    @property
    def _is_decided(self) -> bool:
        """Whether the instruction angle of this tick is known."""
        return self._resting or self.action is not None

    def _begin(self, o: Observation) -> None:
        """Begin a tick; drop actions that arrived since the last one, but accept a pause."""
        self._observation, self.action, self._unsent, self._open = o, None, False, 0
        self._exchange()
        if not self.limits.virtual:
            self._pause = max(0.0, self._pause - o.dt)
            self._resting = self._pause > 0.0
            if self._resting:
                return
        self._question = encode(
            Observed(
                *astuple(o),
                session=self._session,
                seq=self._seq + 1,
                answered_seq=self._answered,
                lost_ticks=self._lost,
                tick=self.limits.tick,
                amplitude=self.limits.amplitude,
            )
        )
        self._unsent = True

    def _exchange(self) -> None:
        """Send and receive as much as is possible without waiting."""
        for _ in range(MAX_MESSAGES_AT_ONCE):
            writable, readable = self._wire.state()
            if self._open and self._wire.connections != self._asked_over:
                self._unsent = True  # a new agent has connected: send it the observation again
            if self._unsent and writable:
                self._send()
            elif readable and self.action is None:
                self._take(self._wire.receive())
            else:
                return

    def _send(self) -> None:
        self._wire.send(self._question)
        self._unsent = False
        self._asked_over = self._wire.connections
        if not self._open:  # otherwise it is sent again
            self._seq += 1
            self._open = self._seq
            self._lost = 0

    def _take(self, message: FromAgent) -> None:
        if message.session != self._session:
            self._foreign += 1  # for another fishd, or for an earlier session
        elif isinstance(message, Pause):
            over = self._pause > 0.0 and message.seconds == 0.0
            self._pause = message.seconds
            if self._open:  # this tick's observation was sent; it is sent again when the pause ends
                self._resting = self._pause > 0.0 and not self.limits.virtual
                self._unsent = over
        elif not 0 < message.seq <= self._seq:
            raise ControllerFault(
                "remote-error",
                f"the agent at {self.parameters.agent} sent an action for observation "
                f"{message.seq}, which was never sent; the latest is {self._seq}",
            )
        elif message.seq == self._open:
            self.action = message.phi_c
            # Another program may listen there once this agent has ended.
            self._wire.bound = not self.limits.virtual
        else:
            self._late += 1

    def _decide(self, observation: Observation) -> float:
        """Return the angle of this tick [rad]; raise `ControllerFault` after too many misses."""
        if self.action is not None:
            self._answered = self._open
            self.silent = self._late = self._foreign = 0
            return self.action
        if self._is_decided:
            self.silent = 0
            return 0.0
        self._lost += 1
        agent, patience = self.parameters.agent, self._patience
        if self.limits.virtual:
            raise _silence_fault(f"the agent at {agent} has not answered within {patience:g} s")
        if not self._answered:
            self._waited += observation.dt
            if self._waited + 0.5 * self.limits.tick < self.parameters.first_action:
                return 0.0
            what = f"from the agent at {agent} within {self.parameters.first_action:g} s"
            if self._late or self._foreign:
                raise _silence_fault(f"no action has come in time {what} ({self._wrong})")
            remedy = self._wire.problem or "start the agent, and check its address"
            raise _silence_fault(f"no action has come {what}; {remedy}")
        self.silent += 1
        if self.silent >= self.parameters.misses:
            raise _silence_fault(
                f"the agent at {agent} has not answered within {patience * 1e3:g} ms, "
                f"{self.silent} ticks in a row ({self._wrong})"
            )
        return 0.0

    @property
    def _wrong(self) -> str:
        """Description of what the agent sent instead of actions in time."""
        late = f"{self._late} answers were late" if self._late else ""
        foreign = f"{self._foreign} were for another session" if self._foreign else ""
        lost = "its connection was lost: select remote again" if self._wire.lost else ""
        return ", ".join(filter(None, (late, foreign, lost))) or "it has sent nothing since"


def _silence_fault(what: str) -> ControllerFault:
    return ControllerFault("remote-silent", what)
