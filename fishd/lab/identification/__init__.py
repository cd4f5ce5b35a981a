"""Identification of a fish and its rig from F_x, F_y and φ_c alone, with intervals.

`identify` fits recordings; `experiment` swims a fish with an informative command.
"""

from fishd.lab.identification.estimation import (
    DEFAULT,
    check,
    continue_experiment,
    experiment,
    identify,
)
from fishd.lab.identification.passages import Unidentifiable
from fishd.lab.identification.result import Channel, Estimate, Fit, Identification

__all__ = [
    "DEFAULT",
    "Channel",
    "Estimate",
    "Fit",
    "Identification",
    "Unidentifiable",
    "check",
    "continue_experiment",
    "experiment",
    "identify",
]
