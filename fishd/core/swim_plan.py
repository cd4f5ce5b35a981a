"""Plan of a measurement: when the fish swims, and when it rests. It needs no numpy."""

import math
from collections.abc import Mapping
from typing import Any

from fishd.core.errors import ParameterError
from fishd.core.estimation import REST_SETTLE_TIME_S, SWIM_SETTLE_TIME_S

MEAN_SWIM_S, MEAN_REST_S = 6.0, 2.75
"""Mean length of a swim and of a rest [s]."""
MIN_SWIM_S, MIN_REST_S = 4.5, 2.25
"""Length of the shortest swim and of the shortest rest [s]."""
GOLDEN_RATIO = (math.sqrt(5.0) - 1.0) / 2.0
"""Number whose multiples, taken modulo 1, are spread evenly and never repeat."""
MAX_MEASUREMENT_S = 3600.0
"""Length of the longest measurement [s]."""


def plan(
    seconds: float, parameters: Mapping[str, Any], settle: float = SWIM_SETTLE_TIME_S
) -> list[tuple[bool, float]]:
    """Return swims (True) and rests (False) in order, with the length of each [s].

    The lengths add up to `seconds`. A slow beat lengthens swims; a long settling time lengthens
    both. Raises `ParameterError` where two swims do not fit.
    """
    frequency = parameters.get("frequency")
    slow_swim = 3.0 / frequency if isinstance(frequency, int | float) and frequency > 0.0 else 0.0
    swim = settle + max(MEAN_SWIM_S - SWIM_SETTLE_TIME_S, slow_swim)
    rest = rest_settle_time(settle) + MEAN_REST_S - REST_SETTLE_TIME_S
    if not 2 * swim + 3 * rest <= seconds <= MAX_MEASUREMENT_S:  # NaN is not
        raise ParameterError(
            f"a measurement of {seconds:g} s is not possible: {2 * swim + 3 * rest:.4g} to "
            f"{MAX_MEASUREMENT_S:g} s are needed, for two or more swims of {swim:.3g} s between "
            f"rests of {rest:.3g} s"
        )
    count = math.floor((seconds - rest) / (swim + rest) + 1e-9)
    shortest = (
        rest - MEAN_REST_S + MIN_REST_S,
        settle + max(MIN_SWIM_S - SWIM_SETTLE_TIME_S, slow_swim),
    )
    weights = [((GOLDEN_RATIO * (index + 1) / 2) % 1.0) ** 2 for index in range(2 * count + 1)]
    spare_time = (seconds - count * sum(shortest) - shortest[False]) / sum(weights)
    return [
        (bool(index % 2), shortest[index % 2] + spare_time * weight)
        for index, weight in enumerate(weights)
    ]


def rest_settle_time(settle: float) -> float:
    """Return the time after which the fin hangs still in a rest [s].

    settle: time until a swim is steady [s]
    """
    return REST_SETTLE_TIME_S + max(0.0, settle - SWIM_SETTLE_TIME_S)
