"""Settings of the control loop: the keys of the configuration that belong to no section."""

from typing import Annotated

from msgspec import Meta, Struct

from fishd.core.schema import unit


class LoopSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the control loop and its guard; `Config` inherits its keys."""

    tick: Annotated[float, unit("s", "Period of the loop.", ge=0.002, le=0.2)] = 0.05
    amplitude_limit: Annotated[
        float, unit("rad", "Φ: instruction angles stay within ±Φ.", gt=0, le=1.57)
    ] = 0.42
    slew_limit: Annotated[
        Annotated[float, Meta(gt=0, le=10_000)] | None,
        unit(
            "rad/s",
            "Largest rate of change of the instruction angle; null: one full reversal, 2Φ, in each "
            "tick.",
        ),
    ] = None
    fade_time: Annotated[
        float, unit("s", "Time to fade from Φ to neutral on stop, fault and exit.", gt=0, le=0.5)
    ] = 0.4
