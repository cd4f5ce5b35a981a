"""Runs in virtual time: the control loop of fishd on a simulated fish, with ticks or a report."""

from fishd.lab.simulation.report import Beats, Report, check_whole_beat, judge, simulate
from fishd.lab.simulation.virtual_run import EncodingPublisher, KeepingPublisher, VirtualRun, run

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
