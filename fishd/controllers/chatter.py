"""How long a learned controller may shake the servo, and what comes then: section `chatter`."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

LONGEST_DWELL = 2.0
"""[s]"""


class ChatterSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What becomes of a policy that reverses too fast."""

    dwell: Annotated[
        float,
        Meta(
            ge=0,
            le=LONGEST_DWELL,
            description="Shortest time between two reversals of ppo, in whole ticks, rounded up; "
            "those that would come sooner are held back. 0 holds none back.",
            extra_json_schema={"unit": "s"},
        ),
    ] = 0.2
    patience: Annotated[
        float,
        Meta(
            ge=0.2,
            le=600,
            description="Who insists on such reversals for so long loses command.",
            extra_json_schema={"unit": "s"},
        ),
    ] = 2.0
    fallback: Annotated[
        Literal["swing", "fault"],
        Meta(description="What comes then: swing takes over, or mode fault."),
    ] = "swing"
