"""The servo wheel, φ̇ = Ω tanh((φ_c − φ)/Δ) of Fu et al., solved exactly for a constant φ_c.

With the lag x = (φ_c − φ)/Δ and the time t in units of Δ/Ω, sinh x(t) = sinh x(0) · exp(−t).
Everything here is in those units, and in logarithms, because sinh overflows at a lag of 710.
"""

import math

_LN2 = math.log(2.0)


def log_sinh(lag: float) -> float:
    """Return ln sinh |lag|, which is also the time until |sinh(lag)| = 1; −inf without a lag."""
    size = abs(lag)
    return size + math.log(-math.expm1(-2.0 * size)) - _LN2 if size else -math.inf


def relax(lag: float, time: float) -> float:
    """Return the lag that is left of `lag` after `time`."""
    exponent = log_sinh(lag) - time
    # Above 20, asinh(exp(y)) and y + ln 2 are the same double.
    size = math.asinh(math.exp(exponent)) if exponent < 20.0 else exponent + _LN2
    return math.copysign(size, lag)


def time_between(lag: float, later: float) -> float:
    """Return the time in which `lag` shrinks to `later`, a smaller lag of the same sign."""
    return log_sinh(lag) - log_sinh(later)


def lag_after_reversal(step: float, half_period: float) -> float:
    """Return the lag right after a reversal of a periodic square wave.

    `step` is the full swing 2Φ/Δ. The lag left at the end of a half period, sinh x · exp(−t), is
    what the next step starts from, sinh(step − x), by antisymmetry; solved here for x.
    """
    return 0.5 * (_log_add_exp(step, -half_period) - _log_add_exp(-step, -half_period))


def _log_add_exp(a: float, b: float) -> float:
    return max(a, b) + math.log1p(math.exp(-abs(a - b)))
