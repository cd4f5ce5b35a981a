"""Experiment with the command that is most informative for an identification."""

import math
from typing import TYPE_CHECKING

from fishd.core.dataframes import ticks_to_frame
from fishd.core.errors import ParameterError
from fishd.lab.session import Session

if TYPE_CHECKING:
    from pandas import DataFrame

REST_S = 4.0
"""Length of the rest before the swim [s]: the tail stands still, so its state is known."""
MIN_EXPERIMENT_S = 30.0
"""Length of the shortest experiment; a shorter one determines too little [s]."""


def experiment(session: Session, seconds: float = 180.0) -> "DataFrame":
    """Rest, then swim `excitation` at the full amplitude of the rig; return one row per tick.

    seconds: length of the experiment, rest included [s]
    Raises `ParameterError` for less than `MIN_EXPERIMENT_S` or an infinite time, `Disturbed` where
    another client takes the fish, and the errors of the session.
    """
    if not MIN_EXPERIMENT_S <= seconds < math.inf:
        raise ParameterError(
            f"an experiment of {seconds:g} s: {MIN_EXPERIMENT_S:g} s or more are needed"
        )
    ticks = session.rest(REST_S)
    ticks += session.swim("excitation", {}, seconds - REST_S)
    return ticks_to_frame(ticks)
