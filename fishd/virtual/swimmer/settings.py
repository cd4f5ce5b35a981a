"""Settings of section `swimmer`: the body, its muscles, the water and the grid."""

from typing import Annotated

from msgspec import Meta, Struct

from fishd.core.schema import unit

DISSIPATION = 0.3
"""Dissipation of the fluxes, as a fraction of that of the upwind-biased scheme of third order."""
MAX_COURANT = 0.35
"""Largest fraction of a cell that the tail is expected to pass in a step. Advection by third-order
Adams–Bashforth with the fluxes of `flow` is stable up to 0.498, and the water around the tail is up
to 1.4 times as fast."""
MIN_CELLS_PER_LENGTH = 40
MIN_CELLS_PER_THICKNESS = 6


class Body(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the 2-D body; masses, forces and powers are those of one metre of depth."""

    length: Annotated[float, unit("m", "Length L from head to tail.", ge=0.005, le=2.0)] = 0.1
    thickness: Annotated[
        float,
        unit(
            "m",
            "H: half of the body's thickness at X is H·s(X/L). H also sets the curvature that the "
            "muscles command, κ = ε₀ (X/L)ⁿ/H: change muscle.strain together with it.",
            gt=0.0,
            le=2.0,
        ),
    ] = 0.04
    profile: Annotated[
        tuple[tuple[float, float], ...] | None,
        Meta(
            description="s as points [X/L, s], with X/L from 0 to 1, linear in between, such as "
            "[[0, 0], [0.3, 0.16], [1, 0]]; null: the paper's s = (X/L)(1 − X/L)exp(−X/L)."
        ),
    ] = None
    young: Annotated[
        float,
        unit(
            "Pa",
            "Young's modulus. With viscosity, it gives the robot's ω₀ and ξ, to which the paper "
            "matches its body; the 1e4 and 1e-4 that it prints do not (fishctl swimmer step).",
            gt=0.0,
            le=1e12,
        ),
    ] = 8200.0
    poisson: Annotated[float, unit("1", "Poisson's ratio.", ge=0.0, lt=0.5)] = 0.3
    viscosity: Annotated[
        float, unit("Pa s", "Viscosity of the material (Kelvin–Voigt).", ge=0.0, le=1e9)
    ] = 720.0
    excess_density: Annotated[
        float, unit("kg/m^3", "Density of the body minus that of the water.", ge=0.0, le=2e4)
    ] = 0.0


class Muscle(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the active strain ε₀ (X/L)ⁿ (Y/H) a, with the activation a from −1 to 1."""

    strain: Annotated[
        float,
        unit(
            "1",
            "Strain ε₀: the tail bends by ε₀L²/12H, which is 0.21 L with 1; the paper prints 0.01.",
            gt=0.0,
            le=100.0,
        ),
    ] = 1.0
    exponent: Annotated[float, unit("1", "Exponent n of the strain.", ge=0.0, le=10.0)] = 2.0
    servo: Annotated[
        bool,
        Meta(
            description="Whether the activation follows the command like the servo of section "
            "plant, with plant.servo_speed and servo_lag; otherwise at once, as in the paper."
        ),
    ] = False


class Water(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the water and its tank, which travels with the fish and has open ends."""

    density: Annotated[float, unit("kg/m^3", "Density ρ.", gt=0.0, le=1e5)] = 1000.0
    viscosity: Annotated[float, unit("m^2/s", "Kinematic viscosity ν.", ge=0.0, le=1.0)] = 1e-6
    length: Annotated[float, unit("m", "Length of the tank.", gt=0.0, le=100.0, usual=20)] = 1.0
    width: Annotated[float, unit("m", "Width of the tank.", gt=0.0, le=100.0, usual=20)] = 0.2


class Numerics(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the grid and the step."""

    cell: Annotated[float, unit("m", "Size of the cells around the fish.", gt=0.0, le=0.1)] = 5e-4
    step: Annotated[float, unit("s", "Time step.", gt=0.0, le=0.1)] = 4e-4
    segments: Annotated[
        int,
        Meta(
            ge=5,
            le=200,
            description="Segments of the beam, each of constant curvature and 1.5 cells or longer.",
        ),
    ] = 25
    fine_length: Annotated[
        float, unit("1", "Length of the part with small cells, in lengths of the fish.", ge=1.2)
    ] = 1.3
    fine_width: Annotated[
        float, unit("1", "Width of the part with small cells, in lengths of the fish.", ge=0.5)
    ] = 0.6
    stretch_along: Annotated[
        float, unit("1", "Ratio of adjacent cells outside, along the tank.", ge=1.0, le=1.2)
    ] = 1.04
    stretch_across: Annotated[
        float, unit("1", "Ratio of adjacent cells outside, across the tank.", ge=1.0, le=1.2)
    ] = 1.06


class SwimmerSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the free swimmer."""

    body: Annotated[Body, Meta(description="The body.")] = Body()
    muscle: Annotated[Muscle, Meta(description="The muscles.")] = Muscle()
    water: Annotated[Water, Meta(description="The water and its tank.")] = Water()
    numerics: Annotated[Numerics, Meta(description="The grid and the time step.")] = Numerics()
    steering: Annotated[
        float,
        unit(
            "1",
            "Gain of a torque that keeps the fish in the middle of the tank; 0: none.",
            ge=0.0,
            le=10.0,
        ),
    ] = 1.0
    sensor_time: Annotated[
        float, unit("s", "Time constant of the filters of the fish's sensors.", ge=0.0, le=1.0)
    ] = 0.005
    slow_motion: Annotated[
        float,
        unit(
            "1",
            "Seconds that a second of the fish takes in a live run, or more on a slow machine.",
            ge=1.0,
            le=1000.0,
        ),
    ] = 5.0
