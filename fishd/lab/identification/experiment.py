"""Lets a fish swim what tells most about it."""

import math
from typing import TYPE_CHECKING

from fishd.core.dataframes import frame
from fishd.core.errors import ParameterError
from fishd.lab.session import Session

if TYPE_CHECKING:
    from pandas import DataFrame

REST = 4.0
"""Rest before it swims [s]: the tail stands still, and its state is known."""
SHORTEST = 30.0
"""Less swimming tells too little [s]."""


def experiment(session: Session, seconds: float = 180.0) -> "DataFrame":
    """Rest, then swim `excitation` at the rig's whole amplitude; a row a tick.

    seconds: how long all of it takes [s]
    Raises `ParameterError` for less than `SHORTEST` or for ever, `Disturbed` where somebody else
    takes the fish, and what the rig raises.
    """
    if not SHORTEST <= seconds < math.inf:
        raise ParameterError(f"an experiment of {seconds:g} s: {SHORTEST:g} s or more are needed")
    ticks = session.rest(REST)
    ticks += session.swim("excitation", {}, seconds - REST)
    return frame(ticks)
