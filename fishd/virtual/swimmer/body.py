"""Body as a beam: its thickness, its stiffness, and the bend by its muscles."""

import numpy as np

from fishd.virtual.swimmer.beam import Beam
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.settings import Body, SwimmerSettings


def half_thickness(body: Body, X: Array) -> Array:
    """Return the half thickness at X [m]."""
    share = X / body.length
    if body.profile is None:
        return np.asarray(body.thickness * share * (1.0 - share) * np.exp(-share))
    shares, values = zip(*body.profile, strict=True)
    return np.asarray(body.thickness * np.interp(share, shares, values))


def curvature(settings: SwimmerSettings, X: Array) -> Array:
    """Return the curvature that the muscles command at full activation, at X [1/m]."""
    body, muscle = settings.body, settings.muscle
    return np.asarray(muscle.strain * (X / body.length) ** muscle.exponent / body.thickness)


def build_beam(settings: SwimmerSettings) -> Beam:
    """Return the body in plane strain, with its head at the origin."""
    body, numerics = settings.body, settings.numerics
    plane = body.young / (1.0 - body.poisson**2)
    return Beam(
        body.length,
        lambda X: half_thickness(body, X),
        lambda X: plane * (2.0 * half_thickness(body, X)) ** 3 / 12.0,
        numerics.segments,
        numerics.cell,
        density=body.excess_density,
        viscous_time=body.viscosity / body.young,
    )
