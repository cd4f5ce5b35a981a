"""Reading of one picture of the tail: its fin angle, and how well it is known."""

from typing import Annotated

from msgspec import Struct

from fishd.core.schema import note, unit

Point = tuple[float, float]
"""Place in a turned picture: column and row of the centre of a pixel [px]."""


MIDLINE_POINTS = 16
"""Number of points of a midline."""


class TailReading(Struct, frozen=True, kw_only=True):
    """Fin angle and midline in one picture, or the reason why the angle is unknown.

    `alpha` is the direction of the straight part of the fin against the fish's axis. It is positive
    where the tail is bent towards the higher rows, which is downwards with the head at the left.
    """

    time: Annotated[
        float, unit("s", "Middle of the exposure of the fin's row, on the camera's clock.")
    ]
    alpha: Annotated[
        float | None, unit("rad", "Fin angle minus `zero`; null where it is unknown.")
    ] = None
    zero: Annotated[float, unit("rad", "Fin angle at rest, which was subtracted.")]
    uncertainty: Annotated[
        float | None,
        unit("rad", "Half-width of its 95 % interval, for noise, waves and blur."),
    ] = None
    reason: Annotated[str, note("Why `alpha` is null, or a warning about it; else empty.")] = ""
    tip: Annotated[Point | None, unit("px", "Column and row of the tip in the turned picture.")] = (
        None
    )
    midline: Annotated[tuple[Point, ...], unit("px", "Up to 16 points from root to tip.")] = ()


class RecordedTail(TailReading, frozen=True, kw_only=True):
    """A reading in a recording; `time` is on fishd's monotonic clock, as `time` of a tick."""

    t: Annotated[float, unit("s", "Middle of the exposure of the fin's row, unix.")]
    seq: Annotated[int, note("Number of the frame from the same picture.")]
    session: Annotated[str, note("Identifier of one run of the camera on one clock.")]
