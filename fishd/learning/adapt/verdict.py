"""Who has won, and the interval of its efficiency."""

import math
from collections.abc import Sequence
from statistics import NormalDist

from fishd.core.errors import FishdError
from fishd.learning.adapt.state import Contender, Verdict

SQUARE = "square"
NAMES = {
    "policy": "the policy",
    "swing": "swing as --C auto has found it",
    SQUARE: "the best square wave found",
}
_LEVEL = 0.05


def judge(contenders: Sequence[Contender]) -> Verdict:
    """The one with the largest measured thrust wins.

    Efficiencies are thrusts over that of the square wave. Their intervals are so wide that all of
    them hold together in 95 % of cases (Bonferroni): that of the winner is as good for having been
    chosen. The square wave itself has 1, without an error.

    contenders: the one named `square` among them
    Raises `FishdError` where that hardly thrusts, so that it is no measure.
    """
    square = next(one for one in contenders if one.name == SQUARE)
    others = [one for one in contenders if one is not square]
    normal = NormalDist()
    wider = normal.inv_cdf(1.0 - 0.5 * _LEVEL / max(1, len(others))) / normal.inv_cdf(0.975)
    shares = {one.name: _share(one, square, wider) for one in others}
    winner = max(contenders, key=lambda one: one.thrust)
    efficiency, low, high = shares.get(winner.name, (1.0, 1.0, 1.0))
    return Verdict(
        winner=winner.name,
        efficiency=efficiency,
        low=low,
        high=high,
        others=shares,
        claim=_claim(winner.name, shares),
    )


def _share(one: Contender, square: Contender, wider: float) -> tuple[float, float, float]:
    """An efficiency with its interval, by Fieller's theorem for independent errors.

    (Fieller, "Some problems in interval estimation", J. R. Stat. Soc. B 16 (1954) 175.)
    """
    a, b = one.thrust, square.thrust
    va, vb = (wider * one.error) ** 2, (wider * square.error) ** 2
    if not b > 0.0 or vb >= b * b:
        raise FishdError(
            f"the best square wave found thrusts {1e3 * b:.2f} ± {1e3 * square.error:.2f} mN: too "
            "little to be told from nothing, so no efficiency is known"
        )
    middle, scale = a * b, b * b - vb
    half = math.sqrt(max(0.0, middle**2 - (a * a - va) * scale))
    return a / b, (middle - half) / scale, (middle + half) / scale


def _claim(winner: str, shares: dict[str, tuple[float, float, float]]) -> str:
    if winner in shares:
        efficiency, low, high = shares[winner]
        clear = "" if low > 1.0 else "; the interval does not tell it from that wave"
        return (
            f"{NAMES[winner]} thrusts {percent(efficiency)} "
            f"[{percent(low)}, {percent(high)}] of {NAMES[SQUARE]}{clear}"
        )
    if not shares:
        return f"{NAMES[SQUARE]} is the only one that could be measured"
    best = max(shares, key=lambda name: shares[name][0])
    efficiency, low, high = shares[best]
    return (
        f"nothing thrusts more than {NAMES[SQUARE]}: {NAMES[best]} has {percent(efficiency)} "
        f"[{percent(low)}, {percent(high)}] of it"
    )


def percent(share: float) -> str:
    """With one decimal."""
    return f"{100.0 * share:.1f} %"
