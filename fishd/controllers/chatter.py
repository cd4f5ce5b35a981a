"""How long a learned controller may shake the servo, and what comes then: section `chatter`."""

from typing import Annotated, Literal

from msgspec import Struct

from fishd.core.schema import note, unit

LONGEST_DWELL = 2.0
"""[s]"""


class ChatterSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What becomes of a policy that reverses too fast."""

    dwell: Annotated[
        float,
        unit(
            "s",
            "Shortest time between two reversals of ppo, in whole ticks, rounded up; those that "
            "would come sooner are held back. 0 holds none back.",
            ge=0,
            le=LONGEST_DWELL,
        ),
    ] = 0.2
    patience: Annotated[
        float, unit("s", "Who insists on such reversals for so long loses command.", ge=0.2, le=600)
    ] = 2.0
    fallback: Annotated[
        Literal["swing", "fault"], note("What comes then: swing takes over, or mode fault.")
    ] = "swing"
