"""Who has won, and the interval of its relative thrust."""

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

    Where the measurement does not tell others from it, that one of them wins which thrusts most on
    the identified fish.

    Relative thrusts are shares of that of the square wave. Their intervals are so wide that all of
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
    first = max(contenders, key=lambda one: one.thrust)
    level = [
        one
        for one in contenders
        if first.thrust - one.thrust <= wider * math.hypot(first.error, one.error)
    ]
    winner = max(level, key=lambda one: one.expected)
    relative_thrust, low, high = shares.get(winner.name, (1.0, 1.0, 1.0))
    return Verdict(
        winner=winner.name,
        relative_thrust=relative_thrust,
        low=low,
        high=high,
        others=shares,
        told=len(level) == 1,
        claim=_claim(winner.name, shares)
        + _untold([one.name for one in level if one is not winner]),
    )


def _share(one: Contender, square: Contender, wider: float) -> tuple[float, float, float]:
    """A relative thrust with its interval, by Fieller's theorem for independent errors.

    (Fieller, "Some problems in interval estimation", J. R. Stat. Soc. B 16 (1954) 175.)
    """
    a, b = one.thrust, square.thrust
    va, vb = (wider * one.error) ** 2, (wider * square.error) ** 2
    if not b > 0.0 or vb >= b * b:
        raise FishdError(
            f"the best square wave found thrusts {1e3 * b:.2f} ± {1e3 * square.error:.2f} mN: too "
            "little to be told from nothing, so no relative thrust is known"
        )
    middle, scale = a * b, b * b - vb
    half = math.sqrt(max(0.0, middle**2 - (a * a - va) * scale))
    return a / b, (middle - half) / scale, (middle + half) / scale


def _claim(winner: str, shares: dict[str, tuple[float, float, float]]) -> str:
    if winner in shares:
        return f"{NAMES[winner]} wins: it thrusts {spelled(shares[winner])} of {NAMES[SQUARE]}"
    if not shares:
        return f"{NAMES[SQUARE]} wins: it is the only one that could be measured"
    others = " and ".join(f"{NAMES[name]} {spelled(share)}" for name, share in shares.items())
    return f"{NAMES[SQUARE]} wins: of its thrust has {others}"


def _untold(names: Sequence[str]) -> str:
    """From whom the measurement does not tell the winner, if from anyone."""
    if not names:
        return ""
    others = " or from ".join(NAMES[name] for name in names)
    return f"; the measurement does not tell it from {others}: on the identified fish it is best"


def spelled(share: tuple[float, float, float]) -> str:
    """A relative thrust with its interval."""
    value, low, high = share
    return f"{percent(value)} [{percent(low)}, {percent(high)}]"


def percent(share: float) -> str:
    """With one decimal."""
    return f"{round(100.0 * share, 1) + 0.0:.1f} %"  # no negative zero
