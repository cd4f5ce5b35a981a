"""`remote`: an agent in another process chooses the instruction angle; docs/how-to/remote.md."""

import os
import time
from typing import Annotated, Any

from msgspec import Meta, Struct
from msgspec.structs import astuple

from fishd.controllers.base import LONGEST_DWELL, Controller, Limits
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
        unit("s", "How long each tick waits for the agent's action; null: 0.4 of the tick."),
    ] = None
    misses: Annotated[
        int,
        unit("ticks", "Ticks in a row without an action in time that are a fault.", ge=1, le=1000),
    ] = 5
    first_action: Annotated[
        float,
        unit(
            "s",
            "How long the agent may take for its first action; neutral until then.",
            gt=0,
            le=3600,
            usual=600,
        ),
    ] = 10.0
    dwell: Annotated[
        float,
        unit(
            "s",
            "Shortest time between two reversals, in whole ticks, rounded up; those that would "
            "come sooner are held back. 0 holds none back.",
            ge=0,
            le=LONGEST_DWELL,
        ),
    ] = 0.0


DEADLINE = 0.4
"""Time for the agent's action by default, as a share of the tick."""
LONGEST_DEADLINE = 0.45
"""Share of the tick; the rest of the half tick that a controller may take is for its own work."""
LONGEST_WAIT = 60.0
"""How long a run in virtual time waits for its agent, pauses not counted [s, real]."""
MOST_AT_ONCE = 200
"""Messages that are read before the time is checked."""


class Remote(Controller[RemoteParameters]):
    """Let an agent choose: a program in another process, on another machine perhaps.

    Each tick sends it the observation and waits for its action until the deadline. A tick without
    one is spent at neutral. An action applies only to the tick whose observation it answers. In
    virtual time a tick lasts until the agent has answered.
    """

    Parameters = RemoteParameters
    action: float | None = quantity("rad", "The agent's action; absent where none came in time.")
    silent: int = quantity("ticks", "Ticks in a row without an action.")

    def __init__(self, parameters: RemoteParameters, limits: Limits) -> None:
        super().__init__(parameters, limits)
        self._wire = Wire(parameters.agent)
        self._limit = DwellLimit(parameters.dwell, limits, limits.amplitude)
        self._session = os.urandom(8).hex()
        self._observation: Observation | None = None
        """Of the tick that is going on."""
        self._question = b""
        self._unsent = False
        self._seq = 0
        self._open = 0
        """The observation whose action is waited for; 0 for none."""
        self._asked_over = 0
        """Number of the connection over which it was sent."""
        self.action = None
        self._resting = False
        """Is this tick part of a pause?"""
        self._pause = 0.0
        """What is left of it; in virtual time, how long it may take [s]."""
        self._answered = 0
        self._lost = 0
        self._late = 0
        """Answers for a tick that was over, since the latest one in time."""
        self._foreign = 0
        """Messages that named another session, since then."""
        self.silent = 0
        self._waited = 0.0
        """For the first action [s]."""
        self._problem: Exception | None = None

    @classmethod
    def check(cls, parameters: Any, limits: Limits) -> None:
        """Refuse what is no address, and a deadline that the tick has no room for."""
        super().check(parameters, limits)
        complaint = find_connect_problem(parameters.agent)
        if complaint:
            raise ParameterError(
                f"agent: '{parameters.agent}' is not valid: {complaint}", ("agent",)
            )
        longest = LONGEST_DEADLINE * limits.tick
        if parameters.deadline is not None and parameters.deadline > longest:
            raise ParameterError(
                f"deadline: {parameters.deadline:g} s is not valid: at most {longest:g} s, "
                f"{LONGEST_DEADLINE:g} of a tick, as half a tick is all that a controller may take",
                ("deadline",),
            )

    def activate(self, observation: Observation) -> None:
        """Take over as if the tail had reversed just now."""
        self._limit.activate(observation.instruction_angle)

    def retune(self, parameters: RemoteParameters) -> None:
        """Take another deadline or limit; another agent has to take over properly."""
        if parameters.agent != self.parameters.agent:
            raise ParameterError(
                "agent: cannot be changed while remote is active; to change agents, use "
                f"'fishctl set-controller remote --agent {parameters.agent}'"
            )
        super().retune(parameters)
        self._limit.dwell = parameters.dwell

    def fileno(self) -> int:
        """A descriptor that is readable once `ready` may have more to say."""
        return self._wire.fileno()

    def ready(self, observation: Observation) -> bool:
        """Ask the agent, without waiting; True once `update` would return at once.

        Call it with the observation of the tick as often as there is news.
        """
        try:
            if observation is not self._observation:
                self._begin(observation)
            self._exchange()
        except Exception as problem:  # a fault of the tick, which lockstep waits for
            self._problem = problem
        return self._settled or self._problem is not None

    def update(self, observation: Observation) -> float:
        """The agent's action [rad], or 0 where none came in time.

        Raises `ControllerFault`: `remote-silent` where that has lasted too long, `remote-error`
        where something else came, `chatter` where it insists on reversals that are held back.
        """
        begun = time.monotonic()
        while not self.ready(observation):
            left = begun + self._patience - time.monotonic()
            if left <= 0.0:
                break
            self._wire.wait(left)
        if self._problem:
            raise self._problem
        return self._limit.apply(self._decide(observation), observation.dt)

    def close(self) -> None:
        """Tell the agent that `remote` is no longer active."""
        self._wire.close(encode(Ended(session=self._session)))

    @property
    def _patience(self) -> float:
        """How long a tick may wait [s]."""
        if self.limits.virtual:
            return LONGEST_WAIT + self._pause
        deadline = self.parameters.deadline
        return DEADLINE * self.limits.tick if deadline is None else deadline

    @property
    def _settled(self) -> bool:
        """Is the command of this tick known?"""
        return self._resting or self.action is not None

    def _begin(self, o: Observation) -> None:
        """Begin a tick; actions that came since the last one are too late, a pause is not."""
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
                answered=self._answered,
                lost=self._lost,
                tick=self.limits.tick,
                amplitude=self.limits.amplitude,
            )
        )
        self._unsent = True

    def _exchange(self) -> None:
        """Send and receive whatever is possible without waiting."""
        for _ in range(MOST_AT_ONCE):
            writable, readable = self._wire.state()
            if self._open and self._wire.connections != self._asked_over:
                self._unsent = True  # the agent is gone: its successor has to be asked again
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
        if not self._open:  # else it is the same one, once more
            self._seq += 1
            self._open = self._seq
            self._lost = 0

    def _take(self, message: FromAgent) -> None:
        if message.session != self._session:
            self._foreign += 1  # for another fishd, or from before this agent took over
        elif isinstance(message, Pause):
            over = self._pause > 0.0 and message.seconds == 0.0
            self._pause = message.seconds
            if self._open:  # this tick has been asked about, and once more when the pause is over
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
        """The command of this tick; raises `ControllerFault` after too many without an action."""
        if self.action is not None:
            self._answered = self._open
            self.silent = self._late = self._foreign = 0
            return self.action
        if self._settled:
            self.silent = 0
            return 0.0
        self._lost += 1
        agent, patience = self.parameters.agent, self._patience
        if self.limits.virtual:
            raise _silence(f"the agent at {agent} has not answered within {patience:g} s")
        if not self._answered:
            self._waited += observation.dt
            if self._waited + 0.5 * self.limits.tick < self.parameters.first_action:
                return 0.0
            what = f"from the agent at {agent} within {self.parameters.first_action:g} s"
            if self._late or self._foreign:
                raise _silence(f"no action has come in time {what} ({self._wrong})")
            raise _silence(f"no action has come {what}: does it run, and is that its address?")
        self.silent += 1
        if self.silent >= self.parameters.misses:
            raise _silence(
                f"the agent at {agent} has not answered within {patience * 1e3:g} ms, "
                f"{self.silent} ticks in a row ({self._wrong})"
            )
        return 0.0

    @property
    def _wrong(self) -> str:
        """What the agent sent instead of actions in time."""
        late = f"{self._late} answers came too late" if self._late else ""
        foreign = f"{self._foreign} named another session" if self._foreign else ""
        lost = "its connection was lost: select remote again" if self._wire.lost else ""
        return ", ".join(filter(None, (late, foreign, lost))) or "it has sent nothing since"


def _silence(what: str) -> ControllerFault:
    return ControllerFault("remote-silent", what)
