"""Section `swimmer` of the configuration: the body, its muscles, the water and the grid."""

from typing import Annotated

from msgspec import Meta, Struct

from fishd.core.schema import unit

LARGEST_COURANT = 0.42
"""The step is short enough where the tail is expected to pass no more than this share of a cell in
it. Adams–Bashforth with fluxes of third order is stable to 0.585 for what is carried along, and the
water around the tail is up to 1.4 times as fast."""
LEAST_CELLS_LONG = 40
LEAST_CELLS_THICK = 6


class Body(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The body: 2-D, and one metre deep where a mass, a force or a power is told."""

    length: Annotated[float, unit("m", "L, from head to tail.", ge=0.005, le=2.0)] = 0.1
    thickness: Annotated[
        float,
        unit(
            "m",
            "H: half of the body's thickness at X is H·s(X/L); in the paper's formula t(X) it has "
            "to be the half one. It also sets the bend that the muscles ask for, κ = ε₀ (X/L)ⁿ/H: "
            "with another thickness muscle.strain is another, too.",
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
    young: Annotated[float, unit("Pa", "Young's modulus.", gt=0.0, le=1e12)] = 1e4
    poisson: Annotated[float, unit("1", "Poisson's ratio.", ge=0.0, lt=0.5)] = 0.3
    viscosity: Annotated[
        float, unit("Pa s", "Viscosity of the material (Kelvin–Voigt).", ge=0.0, le=1e9)
    ] = 1e-4
    excess_density: Annotated[
        float, unit("kg/m^3", "By which the body is heavier than the water.", ge=0.0, le=2e4)
    ] = 0.0


class Muscle(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Active strain ε₀ (X/L)ⁿ (Y/H) a, with the activation a from −1 to 1."""

    strain: Annotated[
        float,
        unit(
            "1",
            "ε₀: the tail bends by ε₀L²/12H, 0.21 L with 1; the paper prints 0.01.",
            gt=0.0,
            le=100.0,
        ),
    ] = 1.0
    exponent: Annotated[float, unit("1", "n.", ge=0.0, le=10.0)] = 2.0
    servo: Annotated[
        bool,
        Meta(
            description="Does the activation follow the command as the servo of section plant "
            "would, with plant.servo_speed and servo_lag? Otherwise at once, as in the paper."
        ),
    ] = False


class Water(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The water and its tank, which travels with the fish: long walls with slip, open ends."""

    density: Annotated[float, unit("kg/m^3", "ρ.", gt=0.0, le=1e5)] = 1000.0
    viscosity: Annotated[float, unit("m^2/s", "Kinematic viscosity ν.", ge=0.0, le=1.0)] = 1e-6
    length: Annotated[float, unit("m", "Of the tank.", gt=0.0, le=100.0, usual=20)] = 1.0
    width: Annotated[float, unit("m", "Of the tank.", gt=0.0, le=100.0, usual=20)] = 0.2


class Numerics(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The grid and the step."""

    cell: Annotated[float, unit("m", "Size of the cells around the fish.", gt=0.0, le=0.1)] = 1e-3
    step: Annotated[float, unit("s", "Time step.", gt=0.0, le=0.1)] = 1e-3
    segments: Annotated[
        int,
        Meta(
            ge=5,
            le=200,
            description="Pieces of the beam, each bent evenly, and at least 1.5 cells long.",
        ),
    ] = 25
    fine_length: Annotated[
        float, unit("1", "Length of the part with small cells, in lengths of the fish.", ge=1.4)
    ] = 2.0
    fine_width: Annotated[
        float, unit("1", "Width of that part, in lengths of the fish.", ge=0.5)
    ] = 1.1
    stretch_along: Annotated[
        float, unit("1", "Growth from cell to cell outside, along the tank.", ge=1.0, le=1.2)
    ] = 1.04
    stretch_across: Annotated[float, unit("1", "The same across it.", ge=1.0, le=1.2)] = 1.06


class SwimmerSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The free swimmer."""

    body: Annotated[Body, Meta(description="The body.")] = Body()
    muscle: Annotated[Muscle, Meta(description="What bends it.")] = Muscle()
    water: Annotated[Water, Meta(description="Where it swims.")] = Water()
    numerics: Annotated[Numerics, Meta(description="How it is computed.")] = Numerics()
    steering: Annotated[
        float,
        unit(
            "1",
            "How firmly a torque, without a net force, keeps the fish on the middle of the "
            "tank; 0: it goes where it goes, and the run ends where cells are coarse.",
            ge=0.0,
            le=10.0,
        ),
    ] = 1.0
    sensor_time: Annotated[
        float,
        unit("s", "Time constant of the filters of what the fish senses.", ge=0.0, le=1.0),
    ] = 0.005
    slow_motion: Annotated[
        float,
        unit(
            "1",
            "Live, a second of the fish takes this number of seconds, or as many more as this "
            "machine needs. Runs in virtual time are as fast as they can be.",
            ge=1.0,
            le=1000.0,
        ),
    ] = 5.0
