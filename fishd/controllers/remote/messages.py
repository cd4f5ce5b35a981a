"""What fishd and an agent say to each other, one JSON object a message; see docs/remote.md.

fishd connects to the agent. Each observation is numbered within its session, and an action names
the observation that it answers: one that comes too late is for no other tick.
"""

from typing import Annotated

import msgspec
from msgspec import Meta, Struct

VERSION = 1
MAX_MESSAGE = 65536
"""Longer messages are not even received [bytes]."""


class Observed(Struct, frozen=True, tag="observation", tag_field="kind", kw_only=True):
    """fishd → agent: what was observed in a tick; an action is wanted."""

    v: int = VERSION
    session: str
    """Names one take-over of the controller `remote`; a new one each time."""
    seq: int
    """Number of this observation in the session, from 1; ticks in a pause are not numbered."""
    answered: int
    """Number of the latest observation whose action was put in command; 0 for none."""
    lost: int
    """Ticks since the observation before this one in which no action was put in command."""
    time: float
    """Start of the tick [s, monotonic]."""
    dt: float
    """Time since the previous tick [s]."""
    fx: float
    fy: float
    fy_rate: float
    fin_velocity: float
    instruction_angle: float
    previous_angle: float
    thrust: float
    frequency: float
    tick: float
    """Period of the loop [s]."""
    amplitude: float
    """Φ [rad]"""


class Ended(Struct, frozen=True, tag="ended", tag_field="kind", kw_only=True):
    """fishd → agent: another controller is in command now, or none; no action is wanted."""

    v: int = VERSION
    session: str


class Action(
    Struct, frozen=True, tag="action", tag_field="kind", kw_only=True, forbid_unknown_fields=True
):
    """Agent → fishd: the answer to an observation."""

    v: int = VERSION
    session: str
    seq: int
    """Number of the observation that this answers."""
    phi_c: float
    """Instruction angle [rad]; the guard clamps it to ±Φ."""


class Pause(
    Struct, frozen=True, tag="pause", tag_field="kind", kw_only=True, forbid_unknown_fields=True
):
    """Agent → fishd, in place of an action: no observations, neutral, for a while; 0 ends it."""

    v: int = VERSION
    session: str
    seconds: Annotated[float, Meta(ge=0, le=3600)]
    """After this time without a `Pause` of 0 s the agent counts as silent."""


FromFish = Observed | Ended
FromAgent = Action | Pause

encode = msgspec.json.Encoder().encode
decode_from_fish = msgspec.json.Decoder(FromFish).decode
decode_from_agent = msgspec.json.Decoder(FromAgent).decode
