"""Can this fish be computed, on this grid, with this step? Said before it swims."""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fishd.core.schema import Problem
from fishd.virtual.swimmer.body import build_beam, curvature, half_thickness
from fishd.virtual.swimmer.settings import (
    LARGEST_COURANT,
    LEAST_CELLS_LONG,
    LEAST_CELLS_THICK,
    Body,
    SwimmerSettings,
)

SHARPEST = 0.9
"""Curvature times half thickness, at most: with 1 the inner side of the bend is folded."""
FURTHEST = 2.5
"""The tail turns against the head by at most so much [rad]."""
MOST_CELLS = 1_000_000
"""Of the grid; a step of so many takes seconds, and a GB of memory."""
MOST_VISCOUS = 0.125
"""ν Δt/h² at most: explicit diffusion by Adams–Bashforth is stable to this in two dimensions. What
is carried along uses up the same limit, that of waves of two cells."""
_CARRIED = 4.0 / 3.0 * 1.4
"""Of that limit, for each cell that the tail is expected to pass in a step: 4/3 by fluxes of third
order, in water that is up to 1.4 times as fast."""
LEAST_SEGMENT = 1.5
"""A piece of the beam is at least so many cells long: shorter ones move too little water."""
THINNEST = 0.05
"""Thickness of the body, ends left out, over its largest."""
AHEAD = 0.05
"""A fish that speeds up gets ahead of the middle of the grid by up to so many of its lengths."""
_MARGIN = 1.2


class Estimate(NamedTuple):
    """What is known of a swimmer before it swims."""

    deflection: float
    """Of the tail at rest with full activation [m]."""
    frequency: float
    """Natural frequency in still water, to some 20 % [Hz]."""
    courant_number: float
    """Share of a cell that the fastest water passes in a step, to some 30 %."""


def estimate(settings: SwimmerSettings) -> Estimate:
    """Deflection, frequency and Courant number, from the beam and the water that it takes along.

    A plate from −b to b that moves normally with Σ aₙ Uₙ(x/b), Uₙ the Chebyshev polynomials of the
    second kind, gives the water around it the energy ½ρπb² Σ aₙ²/(n + 1): thin aerofoil theory
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
    moves = beam.motion(np.zeros(beam.slices))[:, 1, 1:]
    M = moves.T @ (mass[:, None] * moves)
    half = 0.5 * body.length
    angle = np.arccos(beam.X / half - 1.0)
    for n in range(1, 21):
        share = 2.0 / math.pi * beam.spacing / half * np.sin(n * angle) @ moves
        M += water.density * math.pi * half**2 / n * np.outer(share, share)
    squares = np.sort(np.linalg.eigvals(np.linalg.solve(M, beam.K[1:, 1:])).real)
    omega = math.sqrt(max(float(squares[2]), 0.0))  # after two motions without any bending
    fastest = 1.5 * omega * deflection
    courant = fastest * settings.numerics.step / settings.numerics.cell
    return Estimate(deflection, omega / (2.0 * math.pi), courant)


def check(settings: SwimmerSettings) -> None:
    """Raises `Problem` with the key at fault, what is wrong and what would be right."""
    body, numerics = settings.body, settings.numerics
    _check_profile(body)
    _check_cells(settings)
    thickest = 2.0 * float(half_thickness(body, np.linspace(0.0, body.length, 201)).max())
    most = min(body.length / LEAST_CELLS_LONG, thickest / LEAST_CELLS_THICK)
    if numerics.cell > most:
        raise Problem(
            ("swimmer", "numerics", "cell"),
            f"{numerics.cell:g} m is too coarse for a fish {body.length:g} m long and "
            f"{thickest:.3g} m thick: at most {most:.3g} m",
        )
    most_segments = int(body.length / (LEAST_SEGMENT * numerics.cell))
    if numerics.segments > most_segments:
        raise Problem(
            ("swimmer", "numerics", "segments"),
            f"{numerics.segments} are too many for cells of {numerics.cell:g} m: at most "
            f"{most_segments}",
        )
    _check_tank(settings)
    _check_bend(settings)
    try:
        found = estimate(settings)
    except (np.linalg.LinAlgError, FloatingPointError, OverflowError):
        raise Problem(
            ("swimmer", "body"), "its stiffness and the water's density are too far apart"
        ) from None
    _check_step(settings, found.courant_number)


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
    if inside.min() < THINNEST * inside.max():
        raise Problem(
            ("swimmer", "body", "profile"),
            f"between X/L = 0.05 and 0.95 the body must be at least {THINNEST:g} times as thick as "
            "where it is thickest",
        )


def _check_tank(settings: SwimmerSettings) -> None:
    body, water, numerics = settings.body, settings.water, settings.numerics
    beam = build_beam(settings)
    centre = float(beam.share @ beam.X)
    longer = max(centre + AHEAD * body.length, body.length - centre)
    around = float(beam.half_thickness.max()) + 2.0 * numerics.cell
    fine = 2.0 * (longer + around) / body.length
    if numerics.fine_length < fine:
        raise Problem(
            ("swimmer", "numerics", "fine_length"),
            f"{numerics.fine_length:g} is too short for a fish whose centre of mass, "
            f"{centre / body.length:.2g} of its length from the head, is in the middle: at least "
            f"{math.ceil(fine * 100.0 - 1e-9) / 100.0:g}",
        )
    for key, size, share in (
        ("length", water.length, numerics.fine_length),
        ("width", water.width, numerics.fine_width),
    ):
        needed = share * body.length * _MARGIN
        if size < needed:
            raise Problem(
                ("swimmer", "water", key),
                f"a tank of {size:g} m is too small for a fish {body.length:g} m long: at least "
                f"{math.ceil(needed * 1000.0 - 1e-9) / 1000.0:g} m",
            )


def _check_cells(settings: SwimmerSettings) -> None:
    """The grid and the slices of the body fit into memory."""
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
    if cells > MOST_CELLS:
        raise Problem(
            ("swimmer", "numerics", "cell"),
            f"{numerics.cell:g} m would need {cells:.2g} cells, and at most {MOST_CELLS:.2g} are "
            "possible: larger cells, a smaller tank or a stretched grid are needed",
        )


def _check_step(settings: SwimmerSettings, courant: float) -> None:
    numerics, viscosity = settings.numerics, settings.water.viscosity
    viscous = viscosity * numerics.step / numerics.cell**2 / MOST_VISCOUS
    used = max(courant / LARGEST_COURANT, viscous + _CARRIED * courant)
    if used > 1.0:
        longest = numerics.step / used
        digit = 10.0 ** (math.floor(math.log10(longest)) - 1)
        raise Problem(
            ("swimmer", "numerics", "step"),
            f"{numerics.step:g} s is beyond the limit of stability in water of {viscosity:g} m²/s: "
            f"the tail would pass {courant:.2g} cells in a step; at most "
            f"{math.floor(longest / digit) * digit:.2g} s",
        )


def _check_bend(settings: SwimmerSettings) -> None:
    body, muscle = settings.body, settings.muscle
    X = np.linspace(0.0, body.length, 401)
    asked = curvature(settings, X)
    folding = float((asked * half_thickness(body, X)).max()) / SHARPEST
    turning = float(np.trapezoid(asked, X)) / FURTHEST
    if max(folding, turning) > 1.0:
        raise Problem(
            ("swimmer", "muscle", "strain"),
            f"{muscle.strain:g} folds the body upon itself: at most "
            f"{muscle.strain / max(folding, turning):.3g}",
        )
