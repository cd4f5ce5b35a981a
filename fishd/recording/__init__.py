"""Recordings of a fish in MCAP files: writing, reading, export and replay (extra: record).

ticks = fishd.recording.read("run.mcap")      # a pandas DataFrame, one row per tick
run = fishd.recording.open_run("run.mcap")    # its ticks, events, gaps, frames, configuration
"""

from fishd.recording.images import RecordedFrame
from fishd.recording.reader import Entry, Run, open_run, read
from fishd.recording.summary import Gap, Summary
from fishd.recording.writer import RunWriter

__all__ = ["Entry", "Gap", "RecordedFrame", "Run", "RunWriter", "Summary", "open_run", "read"]
