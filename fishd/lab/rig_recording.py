"""A recording of what a rig does, written while it does it."""

import os
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from fishd.core.signals import Event, Tick
from fishd.lab.rig import Rig
from fishd.recording.writer import RunWriter

FLUSH = 0.5
"""All is handed to the kernel this often: a kill loses at most so much [s]."""


@contextmanager
def recorded(
    rig: Rig, path: str | os.PathLike[str], note: str, extra: Mapping[str, str] | None = None
) -> Iterator[RunWriter]:
    """While this lasts, every tick and event of a rig goes into a recording.

    Whatever ends it, what was recorded stays; a recording without a tick does not.

    path: of the finished file, note, extra: as for `RunWriter`
    Raises `RecordingError`, also later where a tick cannot be written, and `NoDaemon`.
    """
    with RunWriter(os.fspath(path), source=rig.source, note=note, extra=extra) as writer:
        rig.describe(writer)
        rig.listener = _Flushing(writer)
        try:
            yield writer
        finally:
            rig.listener = None


class _Flushing:
    """Hands on ticks and events, and flushes."""

    def __init__(self, writer: RunWriter) -> None:
        self._writer = writer
        self._flushed = time.monotonic()

    def tick(self, tick: Tick) -> None:
        self._writer.tick(tick)
        now = time.monotonic()
        if now - self._flushed >= FLUSH:
            self._flushed = now
            self._writer.flush()

    def event(self, event: Event) -> None:
        self._writer.event(event)
