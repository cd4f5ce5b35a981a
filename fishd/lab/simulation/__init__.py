"""Runs in virtual time: the control loop of fishd on a simulated fish, with ticks or a report."""

from fishd.lab.simulation.beats import Beats
from fishd.lab.simulation.report import Report, check_whole_beat, judge, simulate
from fishd.lab.simulation.table import run
from fishd.lab.simulation.virtual_run import EncodingPublisher, KeepingPublisher, VirtualRun

__all__ = [
    "Beats",
    "EncodingPublisher",
    "KeepingPublisher",
    "Report",
    "VirtualRun",
    "check_whole_beat",
    "judge",
    "run",
    "simulate",
]
