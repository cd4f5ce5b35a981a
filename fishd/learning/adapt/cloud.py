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
WIDER = 3.0
"""The errors are taken to be so many times as large where the model lacks something of the fish."""
_Z = 1.96


def cloud(found: Identification, seed: int = 0, count: int = FISH) -> tuple[PlantParameters, ...]:
    """Fish that the data leave possible; the first is the identified one itself.

    They are drawn from the joint normal distribution of the errors, of logarithms for what is
    fitted as such, within the bounds of the fit. Where what is left over is more than noise, the
    intervals may be too narrow, and the errors are taken `WIDER` times as large.
    """
    centre, deviations = np.transpose([_normal(found, name) for name in found.names])
    if not all(channel.white for channel in found.channels):
        deviations = WIDER * deviations
    covariance = found.correlation * np.outer(deviations, deviations)
    draws = np.random.default_rng(seed).multivariate_normal(
        centre, covariance, count - 1, method="eigh", check_valid="ignore"
    )
    fitted = identified(found)
    return (fitted, *(_fish(fitted, found.names, z.tolist()) for z in draws))


def identified(found: Identification) -> PlantParameters:
    """The identified fish."""
    return msgspec.convert(found.plant, PlantParameters)


def _normal(found: Identification, name: str) -> tuple[float, float]:
    """Mean and standard deviation of what is fitted: a logarithm of some."""
    estimate = found[name]
    if name in LOGARITHMIC:
        return float(np.log(estimate.value)), float(np.log(estimate.high / estimate.value)) / _Z
    return estimate.value, (estimate.high - estimate.value) / _Z


def _fish(fitted: PlantParameters, names: tuple[str, ...], z: list[float]) -> PlantParameters:
    drawn = {}
    for name, value in zip(names, z, strict=True):
        low, high = BOUNDS[name]
        plain = float(np.exp(value)) if name in LOGARITHMIC else value
        if name not in OF_THE_RIG:
            drawn[name] = min(high, max(low, plain))
    return replace(fitted, **drawn)
