"""Identification: a fish and its rig from F_x, F_y and φ_c alone, with intervals.

`identify` fits what was recorded, `experiment` lets a fish swim what tells most about it.
"""

from fishd.lab.identification.estimation import DEFAULT, check, identify
from fishd.lab.identification.experiment import experiment
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
    "experiment",
    "identify",
]
