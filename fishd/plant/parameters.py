"""The numbers that make one fish differ from another, shared by the configuration and the plant."""

from typing import Annotated

from msgspec import Meta, Struct


class PlantParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Constants of the servo, the fin and the forces; the defaults are those of Fu et al."""

    omega0: Annotated[
        float,
        Meta(
            ge=0.1,
            le=1e3,
            description="Undamped natural angular frequency of the fin in water, ω₀.",
            extra_json_schema={"unit": "rad/s"},
        ),
    ] = 12.5
    xi: Annotated[
        float,
        Meta(
            ge=0.0,
            le=20.0,
            description="Damping ξ of the fin; its friction term is ξω₀α̇, not 2ξω₀α̇.",
            extra_json_schema={"unit": "1"},
        ),
    ] = 1.2
    coupling: Annotated[
        float,
        Meta(
            gt=0.0,
            le=10.0,
            description="Fin angle at rest per angle of the servo wheel, λ.",
            extra_json_schema={"unit": "1"},
        ),
    ] = 0.46
    servo_speed: Annotated[
        float,
        Meta(
            ge=0.01,
            le=1e4,
            description="Highest angular speed of the servo wheel, Ω.",
            extra_json_schema={"unit": "rad/s"},
        ),
    ] = 5.8
    servo_lag: Annotated[
        float,
        Meta(
            ge=1e-4,
            le=10.0,
            description="Lag of the wheel behind its instruction that saturates the servo, Δ.",
            extra_json_schema={"unit": "rad"},
        ),
    ] = 0.29
    thrust_coefficient: Annotated[
        float,
        Meta(
            gt=0.0,
            le=10.0,
            description="Thrust coefficient K, in F_x = −K α α̈.",
            extra_json_schema={"unit": "N s^2/rad^2"},
        ),
    ] = 12.9e-3
    lateral_drag: Annotated[
        float,
        Meta(
            ge=0.0,
            le=10.0,
            description="Lateral drag coefficient K_d, in F_y = −K α̈ − K_d α̇.",
            extra_json_schema={"unit": "N s/rad"},
        ),
    ] = 39.9e-3
    cable_slack: Annotated[
        float,
        Meta(
            ge=0.0,
            le=1.0,
            description="Wheel angle either side of centre that only takes up slack in the cables.",
            extra_json_schema={"unit": "rad"},
        ),
    ] = 0.0
    backlash: Annotated[
        float,
        Meta(
            ge=0.0,
            le=1.0,
            description="Play of the tail against the wheel, either way: after a reversal the "
            "wheel turns by twice as much before the tail follows.",
            extra_json_schema={"unit": "rad"},
        ),
    ] = 0.0
    servo_delay: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.5,
            description="Time from an instruction until the servo acts on it.",
            extra_json_schema={"unit": "s"},
        ),
    ] = 0.0
    servo_dead_zone: Annotated[
        float,
        Meta(
            ge=0.0,
            le=1.0,
            description="The servo leaves a wheel alone that is this near to its instruction.",
            extra_json_schema={"unit": "rad"},
        ),
    ] = 0.0
    servo_reaction: Annotated[
        float,
        Meta(
            ge=-0.1,
            le=0.1,
            description="Reaction J to the wheel's acceleration that the force sensor feels: "
            "−J φ̈ is added to F_y, smoothed over 10 ms.",
            extra_json_schema={"unit": "N s^2/rad"},
        ),
    ] = 0.0
