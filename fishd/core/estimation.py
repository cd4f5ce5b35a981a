"""Settings and settling times of the estimators, which configuration and laboratory read, too."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from fishd.core.schema import note, unit

SWIM_SETTLE_TIME_S = 1.5
"""Time until a fin that has begun to swim swims steadily [s]."""
REST_SETTLE_TIME_S = 1.0
"""Time until a fin hangs still, fading to neutral included [s]."""
PIECE_S = 0.5
"""Length of the pieces that a rest is cut into, and shortest block of whole beats [s]."""
DEFAULT_LEAK_S, MAX_LEAK_S = 0.3, 100.0
"""Default and largest leak time [s]; K/K_d is 0.323 s for the fish of Fu et al."""


class EstimatorSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the estimator of fin velocity and thrust."""

    kind: Annotated[
        Literal["lateral_force", "observer", "sensor", "tail"],
        note(
            "lateral_force integrates F_y; observer is a Kalman filter on the fish of section "
            "plant, as fishctl identify finds it; sensor takes the angular velocity of the tail "
            "against the front body, which a free fish measures; tail takes the velocity of its "
            "tail across the laboratory, as the paper's swimmer does."
        ),
    ] = "lateral_force"
    leak: Annotated[
        Annotated[float, Meta(gt=0, le=MAX_LEAK_S)] | Literal["auto"],
        unit(
            "s",
            "Of lateral_force: time constant with which the integral of the lateral force decays; "
            "best is K_y/K_d. auto: start with 0.3, and search for the leak that fits F_x.",
        ),
    ] = DEFAULT_LEAK_S
    bias_time: Annotated[
        float,
        unit(
            "s",
            "Of lateral_force: time constant of the average that tracks the offset of F_y.",
            gt=0,
            le=1000,
        ),
    ] = 2.0
    zero_drift: Annotated[
        float,
        unit(
            "N/√s",
            "How fast the zero of F_x drifts, until rests and swims have shown it: standard "
            "deviation of its change in a second.",
            ge=0,
            le=1,
        ),
    ] = 6e-4
    force_noise: Annotated[
        float, unit("N", "Of observer: noise of F_y, rms of the mean over one tick.", gt=0, le=1)
    ] = 1e-3
    offset_drift: Annotated[
        float,
        unit(
            "N/√s",
            "Of observer: standard deviation of the change of the offset of F_y in a second.",
            ge=0,
            le=1,
        ),
    ] = 1e-3
    disturbance: Annotated[
        float,
        unit(
            "rad/s/√s",
            "Of observer: standard deviation of the change of the fin velocity in a second by what "
            "the model lacks.",
            gt=0,
            le=1000,
        ),
    ] = 1.0
    reversed_fy: Annotated[
        Literal["correct", "refuse", "warn"],
        note(
            "Reaction to a first push of the tail that shows that F_y is reversed. correct: "
            "estimator and controllers use F_y with the other sign. refuse: mode fault, and no "
            "controller that uses F_y starts until F_y or the servo is calibrated. warn: only "
            "status says so."
        ),
    ] = "correct"
    sensor_rotation: Annotated[
        float,
        unit(
            "rad",
            "Of observer: angle by which the sensor's axes are turned against the fish.",
            ge=-1.5,
            le=1.5,
        ),
    ] = 0.0
