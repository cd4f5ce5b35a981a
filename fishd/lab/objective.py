"""Thrust for each watt of the servo's electrical power, with its error."""

import math


def per_watt(
    thrust: float, error: float | None, watts: float | None, watts_error: float | None
) -> tuple[float, float] | tuple[None, None]:
    """The ratio of two means and half of its 95 % interval [N/W], to the first order of the errors.

    Both are None where the power or an error is not known, or the servo takes no power.

    error, watts_error: half of the 95 % interval of each
    """
    if not watts or watts_error is None or error is None:
        return None, None
    found = thrust / watts
    return found, math.hypot(error / watts, found * watts_error / watts)
