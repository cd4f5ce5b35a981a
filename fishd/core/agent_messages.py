"""The messages between fishd and an agent, one JSON object each; see docs/how-to/remote.md.

fishd connects to the agent. Each observation is numbered within its session, and an action
names the observation that it answers: an action that comes too late is dropped.
"""

from collections.abc import Callable
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from fishd.core.decoding import decoder
from fishd.core.signals import Observation

VERSION = 2
MAX_MESSAGE = 65536
"""Maximum size of a message; ZeroMQ closes a connection that sends a longer one [bytes]."""


class Observed(Observation, frozen=True, tag="observation", tag_field="kind", kw_only=True):
    """fishd → agent: the observation of a tick; requests an action."""

    v: int = VERSION
    session: str
    """Name of one activation of the controller `remote`; each activation has a new one."""
    seq: int
    """Number of this observation in the session, from 1; ticks in a pause are not numbered."""
    answered_seq: int
    """Number of the latest observation whose action was applied; 0 for none."""
    lost_ticks: int
    """Ticks since the previous observation in which no action was applied."""
    tick: float
    """Period of the loop [s]."""
    amplitude: float
    """Φ [rad]"""


class Ended(Struct, frozen=True, tag="ended", tag_field="kind", kw_only=True):
    """fishd → agent: `remote` is no longer the active controller; requests no action."""

    v: int = VERSION
    session: str


class Action(
    Struct, frozen=True, tag="action", tag_field="kind", kw_only=True, forbid_unknown_fields=True
):
    """Agent → fishd: the action that answers an observation."""

    v: int = VERSION
    session: str
    seq: int
    """Number of the observation that this answers."""
    phi_c: float
    """Instruction angle [rad]; the guard clamps it to ±Φ."""


class Pause(
    Struct, frozen=True, tag="pause", tag_field="kind", kw_only=True, forbid_unknown_fields=True
):
    """Agent → fishd, instead of an action: stay at neutral and send no observations."""

    v: int = VERSION
    session: str
    seconds: Annotated[float, Meta(ge=0, le=3600)]
    """Length of the pause [s]; a `Pause` of 0 s ends it. An agent that has not ended its pause by
    then counts as silent."""


FromFish = Observed | Ended
FromAgent = Action | Pause

encode = msgspec.json.Encoder().encode
decode_from_fish: Callable[[bytes], FromFish] = decoder(FromFish)
decode_from_agent: Callable[[bytes], FromAgent] = decoder(FromAgent)
