"""Lets a fish swim what tells most about it."""

from typing import TYPE_CHECKING

from fishd.core.frames import frame
from fishd.lab.rig import Rig

if TYPE_CHECKING:
    from pandas import DataFrame

REST = 4.0
"""Rest before it swims [s]: the tail stands still, and its state is known."""
SHORTEST = 30.0
"""Less swimming tells too little [s]."""


def experiment(rig: Rig, seconds: float = 180.0) -> "DataFrame":
    """Rest, then swim `excitation` at the rig's whole amplitude; a row a tick.

    seconds: how long all of it takes [s]
    Raises ValueError for less than `SHORTEST`, `Disturbed` where somebody else takes the fish, and
    what the rig raises.
    """
    if not seconds >= SHORTEST:
        raise ValueError(f"an experiment of {seconds:g} s is too short; {SHORTEST:g} s are needed")
    ticks = rig.rest(REST)
    ticks += rig.swim("excitation", {}, seconds - REST)
    return frame(ticks)
