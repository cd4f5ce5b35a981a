"""The fish that an identification leaves possible: draws from its estimates and their errors."""

import msgspec
import numpy as np
from msgspec.structs import replace

from fishd.lab.identification import Identification
from fishd.lab.identification.fit import BOUNDS, LOGARITHMIC
from fishd.lab.identification.result import OF_THE_RIG
from fishd.virtual.plant.parameters import PlantParameters

FISH = 32
"""How many are drawn."""


def cloud(found: Identification, seed: int = 0, count: int = FISH) -> tuple[PlantParameters, ...]:
    """Return fish that the data leave possible; the first is the identified one itself.

    They are drawn from the joint normal distribution of the errors, of logarithms for what is
    fitted as such, within the bounds of the fit. What a misfit adds is part of it. K_y/K is that of
    the identified fish: no force depends on it as long as what it scales goes along.
    """
    centre = [_centre(found, name) for name in found.names]
    draws = np.random.default_rng(seed).multivariate_normal(
        centre, found.covariance, count - 1, method="eigh", check_valid="ignore"
    )
    fitted = identified(found)
    return (fitted, *(_fish(fitted, found.names, z.tolist()) for z in draws))


def identified(found: Identification) -> PlantParameters:
    """The identified fish."""
    return msgspec.convert(found.plant, PlantParameters)


def _centre(found: Identification, name: str) -> float:
    """Return the mean of what is fitted: a logarithm of some."""
    value = found[name].value
    return float(np.log(value)) if name in LOGARITHMIC else value


def _fish(fitted: PlantParameters, names: tuple[str, ...], z: list[float]) -> PlantParameters:
    drawn = {}
    for name, value in zip(names, z, strict=True):
        low, high = BOUNDS[name]
        plain = float(np.exp(value)) if name in LOGARITHMIC else value
        if name not in OF_THE_RIG:
            drawn[name] = min(high, max(low, plain))
    return replace(fitted, **drawn)
