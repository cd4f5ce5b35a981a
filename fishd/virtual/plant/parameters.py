"""Parameters of a fish, shared by the configuration and the plant."""

from typing import Annotated

from msgspec import Struct

from fishd.core.schema import note, unit
from fishd.virtual.plant.servo_law import ServoLaw

TETHERED = "tethered"
"""Name of fishd's built-in model."""
MAX_FIN_ANGLE_RAD = 1.0
"""Largest fin angle of the equations, which replace sin α by α; the error is 19 % here [rad]."""


class PlantParameters(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Constants of the servo, the fin and the forces; the defaults are those of Fu et al."""

    model: Annotated[str, note("Name of the plant, the equations of the simulated fish.")] = (
        TETHERED
    )
    omega0: Annotated[
        float,
        unit(
            "rad/s", "Undamped natural angular frequency of the fin in water, ω₀.", ge=0.1, le=1e3
        ),
    ] = 12.5
    xi: Annotated[
        float,
        unit("1", "Damping ξ of the fin; its friction term is ξω₀α̇, not 2ξω₀α̇.", ge=0.0, le=20.0),
    ] = 1.2
    coupling: Annotated[
        float, unit("1", "Fin angle at rest per angle of the servo wheel, λ.", gt=0.0, le=10.0)
    ] = 0.46
    servo_speed: Annotated[
        float, unit("rad/s", "Highest angular speed of the servo wheel, Ω.", ge=0.01, le=1e4)
    ] = 5.8
    servo_lag: Annotated[
        float,
        unit(
            "rad",
            "Lag of the wheel behind its instruction that saturates the servo, Δ.",
            ge=1e-4,
            le=10.0,
        ),
    ] = 0.29
    servo_law: Annotated[
        ServoLaw,
        note(
            "Law by which the wheel approaches its instruction: its speed is Ω tanh(lag/Δ); or Ω, "
            "and below a lag Δ `linear` in it or in its `square-root`; or with an acceleration of "
            "Ω²/2Δ at most (`accelerating`)."
        ),
    ] = "tanh"
    thrust_coefficient: Annotated[
        float, unit("N s^2/rad^2", "Thrust coefficient K, in F_x = −K α α̈.", gt=0.0, le=10.0)
    ] = 12.9e-3
    lateral_drag: Annotated[
        float,
        unit("N s/rad", "Lateral drag coefficient K_d, in F_y = −K_y α̈ − K_d α̇.", ge=0.0, le=10.0),
    ] = 39.9e-3
    lateral_inertia_ratio: Annotated[
        float,
        unit(
            "1",
            "Ratio K_y/K of the lateral inertia coefficient K_y, in F_y = −K_y α̈ − K_d α̇, to the "
            "thrust coefficient.",
            gt=0.0,
            le=100.0,
        ),
    ] = 1.0
    quadratic_drag: Annotated[
        float,
        unit("1/rad", "Quadratic drag c of the fin: −c |α̇| α̇ is added to α̈.", ge=0.0, le=100.0),
    ] = 0.0
    lateral_quadratic_drag: Annotated[
        float,
        unit(
            "N s^2/rad^2",
            "Quadratic lateral drag coefficient K_q: −K_q |α̇| α̇ is added to F_y.",
            ge=0.0,
            le=10.0,
        ),
    ] = 0.0
    cable_slack: Annotated[
        float,
        unit(
            "rad",
            "Wheel angle on either side of the centre that only takes up slack in the cables.",
            ge=0.0,
            le=1.0,
        ),
    ] = 0.0
    backlash: Annotated[
        float,
        unit(
            "rad",
            "Play of the tail relative to the wheel, in either direction.",
            ge=0.0,
            le=1.0,
        ),
    ] = 0.0
    servo_delay: Annotated[
        float, unit("s", "Time from an instruction until the servo acts on it.", ge=0.0, le=0.5)
    ] = 0.0
    servo_dead_zone: Annotated[
        float,
        unit(
            "rad",
            "Difference between wheel and instruction up to which the servo does not move.",
            ge=0.0,
            le=1.0,
        ),
    ] = 0.0
    servo_reaction: Annotated[
        float,
        unit(
            "N s^2/rad",
            "Reaction J to the wheel's acceleration on the force sensor: −J φ̈ is added to F_y, "
            "smoothed over 10 ms.",
            ge=-0.1,
            le=0.1,
        ),
    ] = 0.0

    @property
    def lateral_inertia(self) -> float:
        """Lateral inertia coefficient K_y [N s²/rad²]."""
        return self.lateral_inertia_ratio * self.thrust_coefficient


def without_extensions(parameters: PlantParameters) -> PlantParameters:
    """Return the fish with only the parameters of the equations of Fu et al."""
    p = parameters
    return PlantParameters(
        omega0=p.omega0,
        xi=p.xi,
        coupling=p.coupling,
        servo_speed=p.servo_speed,
        servo_lag=p.servo_lag,
        thrust_coefficient=p.thrust_coefficient,
        lateral_drag=p.lateral_drag,
    )


class MotorSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Motor of the simulated servo; the defaults are typical values of a standard servo."""

    voltage: Annotated[float, unit("V", "Supply voltage of the servo, U.", gt=0.0, le=60.0)] = 6.0
    idle_current: Annotated[
        float, unit("A", "Current of the electronics, with and without pulses.", ge=0.0, le=10.0)
    ] = 0.01
    no_load_current: Annotated[
        float,
        unit(
            "A",
            "Additional current at the highest speed without a load, i₀; proportional to speed.",
            ge=0.0,
            le=10.0,
        ),
    ] = 0.2
    stall_current: Annotated[
        float, unit("A", "Current of the blocked motor.", gt=0.0, le=100.0)
    ] = 2.0
    stall_torque: Annotated[
        float, unit("N m", "Torque at the blocked wheel.", gt=0.0, le=100.0)
    ] = 1.0
    rotor_inertia: Annotated[
        float,
        unit(
            "kg m^2",
            "Moment of inertia of rotor and gears at the wheel: that of the rotor times the "
            "square of the gear ratio.",
            ge=0.0,
            le=1.0,
        ),
    ] = 1e-3
    tail_inertia: Annotated[
        float,
        unit(
            "kg m^2",
            "Moment of inertia I of the tail about its hinge, with added mass of the water.",
            ge=0.0,
            le=10.0,
        ),
    ] = 1.3e-3
