"""Settings of a simulated camera."""

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
        float,
        unit("s", "Time from the middle of the exposure until the frame is available.", ge=0, le=1),
    ] = 0.03
    jitter: Annotated[float, unit("s", "Standard deviation of the latency.", ge=0, le=0.2)] = 0.0
    exposure: Annotated[float, unit("s", "Exposure time.", ge=0, le=0.2)] = 0.01
    noise: Annotated[
        float, unit("1", "Standard deviation of a pixel's noise, in grey levels.", ge=0, le=100)
    ] = 4.0
    contrast: Annotated[
        float, unit("1", "Grey level of the water minus that of the tail.", gt=0, le=170)
    ] = 100.0
    caustics: Annotated[
        float,
        unit(
            "1", "Standard deviation of the moving pattern of light, in grey levels.", ge=0, le=100
        ),
    ] = 0.0
    light_drift: Annotated[
        float, unit("1", "Relative amplitude of the slow change of the light.", ge=0, lt=1)
    ] = 0.0
    side_light: Annotated[
        float,
        unit(
            "1",
            "Difference in grey level between the two sides of the axis.",
            ge=-100,
            le=100,
        ),
    ] = 0.0
    off_axis: Annotated[
        float,
        unit("px", "Distance of the fish's axis from the middle of the frame.", ge=-40, le=40),
    ] = 0.0
    tilt: Annotated[
        float,
        unit(
            "rad", "Angle of the fish's axis to the frame's rows.", ge=-math.pi / 8, le=math.pi / 8
        ),
    ] = 0.0
    seed: Annotated[int, note("Seed of the random numbers for noise, light and jitter.", ge=0)] = 0


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
"""Settings of a cheap USB camera on a stand."""
