"""What a simulated camera sees, and how badly."""

import math
from typing import Annotated

from msgspec import Meta, Struct

from fishd.core.schema import note, unit


class SimulatedCameraSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Timing, optics and light of a simulated camera; the defaults are the rig `default`."""

    rate: Annotated[
        Annotated[float, Meta(gt=0, le=1000)] | None,
        unit("1/s", "Frames per second; null: one for each tick, in phase with it."),
    ] = None
    latency: Annotated[
        float, unit("s", "From the middle of the exposure until the frame is there.", ge=0, le=1)
    ] = 0.03
    jitter: Annotated[float, unit("s", "Standard deviation of the latency.", ge=0, le=0.2)] = 0.0
    exposure: Annotated[float, unit("s", "Length of the exposure.", ge=0, le=0.2)] = 0.01
    noise: Annotated[
        float, unit("1", "Standard deviation of a pixel's noise, in grey levels.", ge=0, le=100)
    ] = 4.0
    contrast: Annotated[float, unit("1", "Water over tail, in grey levels.", gt=0, le=170)] = 100.0
    caustics: Annotated[
        float,
        unit("1", "Moving pattern of light, its standard deviation in grey levels.", ge=0, le=100),
    ] = 0.0
    light_drift: Annotated[
        float, unit("1", "Share by which the light slowly becomes more and less.", ge=0, lt=1)
    ] = 0.0
    side_light: Annotated[
        float,
        unit(
            "1",
            "Grey levels by which one side of the axis is lighter than the other.",
            ge=-100,
            le=100,
        ),
    ] = 0.0
    off_axis: Annotated[
        float, unit("px", "Axis of the fish from the middle of the frame.", ge=-40, le=40)
    ] = 0.0
    tilt: Annotated[
        float,
        unit("rad", "Axis of the fish against the frame's rows.", ge=-math.pi / 8, le=math.pi / 8),
    ] = 0.0
    seed: Annotated[int, note("Same seed, same noise, light and jitter.", ge=0)] = 0


DEFAULT = SimulatedCameraSettings()
WEB = SimulatedCameraSettings(
    rate=30.0,
    latency=0.05,
    jitter=0.005,
    exposure=0.02,
    noise=6.0,
    caustics=12.0,
    side_light=20.0,
    off_axis=3.0,
    tilt=0.02,
)
"""A cheap USB camera on a stand."""
