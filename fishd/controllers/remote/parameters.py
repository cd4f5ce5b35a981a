"""The parameters of the controller `remote`."""

from typing import Annotated

from msgspec import Meta, Struct

from fishd.controllers.chatter import LONGEST_DWELL


class RemoteParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of `remote`."""

    agent: Annotated[
        str,
        Meta(
            min_length=1,
            max_length=200,
            description="ZeroMQ address that the agent has bound and that fishd connects to: "
            "tcp://HOST:PORT or ipc://PATH.",
            extra_json_schema={"unit": "1"},
        ),
    ] = "tcp://127.0.0.1:9873"
    deadline: Annotated[
        Annotated[float, Meta(gt=0, le=0.1)] | None,
        Meta(
            description="How long each tick waits for the agent's action; null: 0.4 of the tick.",
            extra_json_schema={"unit": "s"},
        ),
    ] = None
    misses: Annotated[
        int,
        Meta(
            ge=1,
            le=1000,
            description="Ticks in a row without an action in time that are a fault.",
            extra_json_schema={"unit": "ticks"},
        ),
    ] = 5
    first_action: Annotated[
        float,
        Meta(
            gt=0,
            le=3600,
            description="How long the agent may take for its first action; neutral until then.",
            extra_json_schema={"unit": "s"},
        ),
    ] = 10.0
    dwell: Annotated[
        float,
        Meta(
            ge=0,
            le=LONGEST_DWELL,
            description="Shortest time between two reversals, in whole ticks, rounded up; those "
            "that would come sooner are held back. 0 holds none back.",
            extra_json_schema={"unit": "s"},
        ),
    ] = 0.0
