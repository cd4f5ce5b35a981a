"""The fish that an identification leaves possible: draws from its estimates and their errors."""

import msgspec
import numpy as np
from msgspec.structs import replace

from fishd.lab.identification import Identification
from fishd.lab.identification.fit import BOUNDS, LOGARITHMIC
from fishd.lab.identification.result import RIG_PARAMETERS
from fishd.virtual.plant.parameters import PlantParameters

CLOUD_SIZE = 32
"""Number of fish in the cloud."""


def draw_cloud(
    identification: Identification, seed: int = 0, count: int = CLOUD_SIZE
) -> tuple[PlantParameters, ...]:
    """Return fish that agree with the data; the first is the identified one itself.

    They are drawn from the joint normal distribution of the errors, of logarithms for parameters
    that are fitted as such, within the bounds of the fit. The errors include those of a misfit.
    K_y/K is that of the identified fish: no force depends on it as long as the parameters that it
    scales change with it.
    """
    centre = [_mean_of_draws(identification, name) for name in identification.names]
    draws = np.random.default_rng(seed).multivariate_normal(
        centre, identification.covariance, count - 1, method="eigh", check_valid="ignore"
    )
    fitted = identified_fish(identification)
    return (fitted, *(_fish(fitted, identification.names, z.tolist()) for z in draws))


def identified_fish(identification: Identification) -> PlantParameters:
    """Return the identified fish."""
    return msgspec.convert(identification.plant, PlantParameters)


def _mean_of_draws(identification: Identification, name: str) -> float:
    """Return the mean of a fitted parameter, or of its logarithm if that is fitted."""
    value = identification[name].value
    return float(np.log(value)) if name in LOGARITHMIC else value


def _fish(fitted: PlantParameters, names: tuple[str, ...], z: list[float]) -> PlantParameters:
    drawn = {}
    for name, value in zip(names, z, strict=True):
        low, high = BOUNDS[name]
        plain = float(np.exp(value)) if name in LOGARITHMIC else value
        if name not in RIG_PARAMETERS:
            drawn[name] = min(high, max(low, plain))
    return replace(fitted, **drawn)
