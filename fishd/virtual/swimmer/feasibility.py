"""Check before a swim whether this fish can be computed with this grid and step."""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fishd.core.schema import Problem
from fishd.virtual.swimmer.body import build_beam, curvature, half_thickness
from fishd.virtual.swimmer.settings import (
    DISSIPATION,
    MAX_COURANT,
    MIN_CELLS_PER_LENGTH,
    MIN_CELLS_PER_THICKNESS,
    Body,
    SwimmerSettings,
)

MAX_BEND = 0.9
"""Largest product of curvature and half thickness; at 1 the inner side of the bend is folded."""
MAX_TAIL_TURN_RAD = 2.5
"""Largest angle of the tail to the head [rad]."""
MAX_CELLS = 1_000_000
"""Largest number of cells; a step then takes seconds, and 1 GB of memory."""
MAX_DECAY = 6.0 / 11.0
"""Largest decay in a step of waves of two cells, the limit of stability of third-order
Adams–Bashforth."""
MAX_DIFFUSION_NUMBER = MAX_DECAY / 8.0
"""Largest ν Δt/h² in two dimensions. The dissipation of the fluxes uses up the same limit."""
_ADVECTION_FRACTION = 4.0 / 3.0 * DISSIPATION / MAX_DECAY * 1.4
"""Fraction of that limit for each cell that the tail is expected to pass in a step, in water that
is up to 1.4 times as fast."""
MIN_SEGMENT_CELLS = 1.5
"""Smallest length of a segment of the beam [cells]; shorter ones move too little water."""
MIN_THICKNESS_FRACTION = 0.05
"""Smallest thickness of the body without its ends, relative to the largest."""
MAX_LEAD_LENGTHS = 0.05
"""Largest lead of an accelerating fish over the middle of the grid [body lengths]."""
MIN_TAIL_DAMPING = 0.05
"""Smallest damping ηω₀/E of the material with which the tip of the tail follows the body. With 0.01
it flutters, swing by the velocity of the tail turns the fish, and it leaves its grid."""
_TANK_MARGIN = 1.2
"""Smallest size of the tank relative to that of the part with small cells."""


class Estimate(NamedTuple):
    """Estimates for a swimmer before it swims."""

    deflection: float
    """Deflection of the tail at rest with full activation [m]."""
    frequency: float
    """Natural frequency in still water, accurate to about 20 % [Hz]."""
    courant_number: float
    """Fraction of a cell that the fastest water passes in a step, accurate to about 30 %."""


def estimate(settings: SwimmerSettings) -> Estimate:
    """Return deflection, frequency and Courant number, from the beam and its added mass.

    A plate from −b to b with the normal velocity Σ aₙ Uₙ(x/b), Uₙ the Chebyshev polynomials of the
    second kind, gives the water around it the energy ½ρπb² Σ aₙ²/(n + 1), by thin aerofoil theory
    without circulation (Katz and Plotkin, Low-Speed Aerodynamics, chapter 5).
    """
    beam = build_beam(settings)
    body, water = settings.body, settings.water
    force = beam.drive(lambda X: curvature(settings, X))
    bent = np.zeros(beam.size)
    bent[2:] = np.linalg.lstsq(beam.K[2:, 2:], force[2:], rcond=None)[0]
    bent[2:] -= bent[2]
    places, _ = beam.shape(bent)
    deflection = abs(float(places[-1, 1]))
    mass = (water.density + body.excess_density) * beam.share * beam.area
    jacobian = beam.motion(np.zeros(beam.slices))[:, 1, 1:]
    M = jacobian.T @ (mass[:, None] * jacobian)
    half = 0.5 * body.length
    angle = np.arccos(beam.X / half - 1.0)
    for n in range(1, 21):
        share = 2.0 / math.pi * beam.spacing / half * np.sin(n * angle) @ jacobian
        M += water.density * math.pi * half**2 / n * np.outer(share, share)
    squares = np.sort(np.linalg.eigvals(np.linalg.solve(M, beam.K[1:, 1:])).real)
    omega = math.sqrt(max(float(squares[2]), 0.0))  # the first two modes are rigid motions
    fastest = 1.5 * omega * deflection
    courant = fastest * settings.numerics.step / settings.numerics.cell
    return Estimate(deflection, omega / (2.0 * math.pi), courant)


def check(settings: SwimmerSettings) -> None:
    """Raise `Problem` with the wrong key, its error and a valid value."""
    body, numerics = settings.body, settings.numerics
    _check_profile(body)
    _check_cells(settings)
    thickest = 2.0 * float(half_thickness(body, np.linspace(0.0, body.length, 201)).max())
    max_cell = min(body.length / MIN_CELLS_PER_LENGTH, thickest / MIN_CELLS_PER_THICKNESS)
    if numerics.cell > max_cell:
        raise Problem(
            ("swimmer", "numerics", "cell"),
            f"{numerics.cell:g} m is too coarse for a fish {body.length:g} m long and "
            f"{thickest:.3g} m thick: at most {max_cell:.3g} m",
        )
    max_segments = int(body.length / (MIN_SEGMENT_CELLS * numerics.cell))
    if numerics.segments > max_segments:
        raise Problem(
            ("swimmer", "numerics", "segments"),
            f"{numerics.segments} are too many for cells of {numerics.cell:g} m: at most "
            f"{max_segments}",
        )
    _check_tank(settings)
    _check_bend(settings)
    try:
        estimates = estimate(settings)
    except (np.linalg.LinAlgError, FloatingPointError, OverflowError):
        raise Problem(
            ("swimmer", "body"), "its stiffness and the water's density are too far apart"
        ) from None
    _check_step(settings, estimates.courant_number)


def check_tail(settings: SwimmerSettings) -> None:
    """Raise `Problem` if the velocity of the tail is that of a tip that flutters."""
    body, omega = settings.body, 2.0 * math.pi * estimate(settings).frequency
    if body.viscosity * omega / body.young < MIN_TAIL_DAMPING:
        raise Problem(
            ("estimator", "kind"),
            f"tail is not valid with a swimmer.body.viscosity of {body.viscosity:g} Pa s: the tip "
            f"of this tail flutters; {MIN_TAIL_DAMPING * body.young / omega:.2g} Pa s or more, or "
            "sensor, is needed",
        )


def _check_profile(body: Body) -> None:
    points = body.profile
    if points is None:
        return
    if not all(math.isfinite(number) for point in points for number in point):
        raise Problem(("swimmer", "body", "profile"), "needs finite numbers")
    shares = [share for share, _ in points]
    rising = all(a < b for a, b in pairwise(shares))
    if len(points) < 2 or not rising or shares[0] != 0.0 or shares[-1] != 1.0:
        raise Problem(
            ("swimmer", "body", "profile"),
            "needs points [X/L, s] with X/L rising from 0 to 1, such as "
            "[[0, 0], [0.3, 0.16], [1, 0]]",
        )
    if min(s for _, s in points) < 0.0 or max(s for _, s in points) <= 0.0:
        raise Problem(("swimmer", "body", "profile"), "s must be 0 or more, and somewhere above")
    inside = half_thickness(body, np.linspace(0.05, 0.95, 181) * body.length)
    if inside.min() < MIN_THICKNESS_FRACTION * inside.max():
        raise Problem(
            ("swimmer", "body", "profile"),
            f"between X/L = 0.05 and 0.95 the body must be at least {MIN_THICKNESS_FRACTION:g} "
            "times as thick as where it is thickest",
        )


def _check_tank(settings: SwimmerSettings) -> None:
    body, water, numerics = settings.body, settings.water, settings.numerics
    beam = build_beam(settings)
    around = float(beam.half_thickness.max()) + 2.0 * numerics.cell
    fine = 1.0 + 2.0 * (MAX_LEAD_LENGTHS + around / body.length)
    if numerics.fine_length < fine:
        raise Problem(
            ("swimmer", "numerics", "fine_length"),
            f"{numerics.fine_length:g} is too short for a fish {around:.2g} m thick with cells of "
            f"{numerics.cell:g} m: at least {math.ceil(fine * 100.0 - 1e-9) / 100.0:g}",
        )
    for key, size, share in (
        ("length", water.length, numerics.fine_length),
        ("width", water.width, numerics.fine_width),
    ):
        needed = share * body.length * _TANK_MARGIN
        if size < needed:
            raise Problem(
                ("swimmer", "water", key),
                f"a tank of {size:g} m is too small for a fish {body.length:g} m long: at least "
                f"{math.ceil(needed * 1000.0 - 1e-9) / 1000.0:g} m",
            )


def _check_cells(settings: SwimmerSettings) -> None:
    """Check that the grid and the slices of the body fit into memory."""
    body, water, numerics = settings.body, settings.water, settings.numerics
    cells = 1.0
    for size, share, ratio in (
        (water.length, numerics.fine_length, numerics.stretch_along),
        (water.width, numerics.fine_width, numerics.stretch_across),
    ):
        fine = share * body.length / numerics.cell
        outside = max(0.0, size / numerics.cell - fine)
        if ratio > 1.0:
            outside = 2.0 * math.log1p(0.5 * outside * (ratio - 1.0)) / math.log(ratio)
        cells *= fine + outside
    if cells > MAX_CELLS:
        raise Problem(
            ("swimmer", "numerics", "cell"),
            f"{numerics.cell:g} m would need {cells:.2g} cells, and at most {MAX_CELLS:.2g} are "
            "possible: use larger cells, a smaller tank or a stretched grid",
        )


def _check_step(settings: SwimmerSettings, courant: float) -> None:
    numerics, viscosity = settings.numerics, settings.water.viscosity
    viscous = viscosity * numerics.step / numerics.cell**2 / MAX_DIFFUSION_NUMBER
    limit_use = max(courant / MAX_COURANT, viscous + _ADVECTION_FRACTION * courant)
    if limit_use > 1.0:
        max_step = numerics.step / limit_use
        digit = 10.0 ** (math.floor(math.log10(max_step)) - 1)
        raise Problem(
            ("swimmer", "numerics", "step"),
            f"{numerics.step:g} s is beyond the limit of stability in water of {viscosity:g} m²/s: "
            f"the tail would pass {courant:.2g} cells in a step; at most "
            f"{math.floor(max_step / digit) * digit:.2g} s",
        )


def _check_bend(settings: SwimmerSettings) -> None:
    body, muscle = settings.body, settings.muscle
    X = np.linspace(0.0, body.length, 401)
    commanded = curvature(settings, X)
    bend_ratio = float((commanded * half_thickness(body, X)).max()) / MAX_BEND
    turn_ratio = float(np.trapezoid(commanded, X)) / MAX_TAIL_TURN_RAD
    if max(bend_ratio, turn_ratio) > 1.0:
        raise Problem(
            ("swimmer", "muscle", "strain"),
            f"{muscle.strain:g} folds the body upon itself: at most "
            f"{muscle.strain / max(bend_ratio, turn_ratio):.3g}",
        )
