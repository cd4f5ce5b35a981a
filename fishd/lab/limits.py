"""Largest values in a recording of a fish: a larger one is a mistake, mostly of its unit."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Limit(NamedTuple):
    """Largest plausible magnitude of a quantity."""

    value: float
    unit: str
    advice: str
    """Question about the unit that such a mistake has."""


_MN, _DEGREES = "is it in mN ({}_mN)?", "is it in degrees ({}_deg)?"
LIMITS = {
    "time": Limit(1e10, "s", "is it in milliseconds ({}_ms) or microseconds ({}_us)?"),
    "fx": Limit(100.0, "N", _MN),
    "fy": Limit(100.0, "N", _MN),
    "phi_c": Limit(math.pi, "rad", _DEGREES),
    "alpha": Limit(math.pi, "rad", _DEGREES),
    "power": Limit(1e4, "W", "is it in mW ({}_mW)?"),
}


def find_excess(name: str, values: ArrayLike) -> str | None:
    """Return in words which value of a quantity is implausible; None if none is.

    values: finite values in SI units, any shape
    """
    limit = LIMITS[name]
    largest = float(np.max(np.abs(values), initial=0.0))
    if largest <= limit.value * (1.0 + 1e-9):  # 180 degrees are permitted
        return None
    size = f"{largest:.3g} {limit.unit} somewhere, more than {limit.value:.3g} {limit.unit}"
    return f"{name} is {size}: {limit.advice.format(name, name)}"
