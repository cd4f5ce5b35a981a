"""The parameters of the controller `remote`."""

from typing import Annotated

from msgspec import Meta, Struct

from fishd.controllers.chatter import LONGEST_DWELL
from fishd.core.schema import unit


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
