"""Log of the swims and rests that an experiment on a live fish has finished, to resume it."""

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from fishd.core.errors import FishdError, RecordingError
from fishd.core.signals import Tick
from fishd.lab.experiment import Experiment
from fishd.lab.session import Replaced, concerns_one_controller
from fishd.recording.part_file import PART_SUFFIX
from fishd.recording.reader import open_run
from fishd.recording.writer import RunWriter

REQUEST_COLUMNS = ("controller", "parameters", "seconds")
"""Columns of what the experiment requested; a rest has no controller."""
SWIMS = "swims.csv"
COLUMNS = (*REQUEST_COLUMNS, "failure", "ticks", "first_tick", "last_tick", "recording")


class SwimLog:
    """Table with a row for each finished swim or rest, whose ticks are in a recording.

    A resumed experiment requests the same swims and rests again, in the same order. For those in
    the log it gets the recorded ticks, and the recorded failures of controllers.
    """

    def __init__(self, experiment: Experiment, writer: RunWriter, period: float) -> None:
        """
        writer: writer of the recording of this session
        period: period of the loop [s]

        Raises `ConfigError` where the table belongs to another experiment, and `FishdError`.
        """
        self._experiment, self._writer, self._period = experiment, writer, period
        self._last: Tick | None = None
        self._offset = 0
        """Number that is added to the ticks of this fishd, so that numbers always increase."""
        self._table = experiment.open_table(COLUMNS, SWIMS)
        rows = self._table.rows
        while rows and rows[-1]["failure"]:  # the experiment ended with it: it is tried again
            rows.pop()
        self._finished: list[tuple[dict[str, str], list[Tick]]] = []
        """Rows of earlier sessions, each with its ticks."""
        self._passed = 0
        """Number of these that this session has requested."""
        read_ticks = cache(_read_ticks)
        for row in rows:
            ticks = []
            if not row["failure"]:
                first, last = int(row["first_tick"]), int(row["last_tick"])
                recorded = read_ticks(experiment.path / row["recording"])
                ticks = [tick for tick in recorded if first <= tick.seq <= last]
                if len(ticks) < int(row["ticks"]):  # the computer lost power
                    break
            self._finished.append((row, ticks))
        self._drop_after(len(self._finished))

    def swim(
        self,
        controller: str,
        parameters: Mapping[str, Any],
        seconds: float,
        swim: Callable[[], list[Tick]],
    ) -> list[Tick]:
        """Return the ticks of the next swim or rest in the log; without one, swim and log it.

        Rows from the first one on that is of another request, as that of a search with a larger
        budget, are dropped.

        controller: empty for a rest
        swim: function that swims or rests, and returns the ticks

        Raises the errors of `swim`, and that of the log as `Replaced`.
        """
        values = (controller, msgspec.json.encode(parameters).decode(), repr(seconds))
        request = dict(zip(REQUEST_COLUMNS, values, strict=True))
        if self._passed < len(self._finished):
            row, ticks = self._finished[self._passed]
            if all(row[name] == value for name, value in request.items()):
                self._passed += 1
                if row["failure"]:
                    raise Replaced(row["failure"])
                return self._in_order(ticks)
            self._drop_after(self._passed)
        try:
            ticks = swim()
        except FishdError as error:
            if concerns_one_controller(error):
                self._add(request, failure=str(error))
            raise
        self._writer.flush()  # the row promises that the ticks are in the recording
        self._add(request, ticks=len(ticks), first_tick=ticks[0].seq, last_tick=ticks[-1].seq)
        return self._in_order(ticks)

    def _drop_after(self, count: int) -> None:
        del self._finished[count:]
        self._table.replace([row for row, _ in self._finished])

    def _add(self, request: dict[str, str], **values: Any) -> None:
        self._table.add({**request, **values, "recording": self._writer.path.name})

    def _in_order(self, ticks: list[Tick]) -> list[Tick]:
        """Return the ticks with numbers above the last one, also those of a restarted fishd."""
        if self._last and ticks[0].seq + self._offset <= self._last.seq:
            pause = round((ticks[0].time - self._last.time) / self._period)
            self._offset = self._last.seq + max(2, pause) - ticks[0].seq
        if self._offset:
            ticks = [replace(tick, seq=tick.seq + self._offset) for tick in ticks]
        self._last = ticks[-1]
        return ticks


def _read_ticks(path: Path) -> list[Tick]:
    """Return the ticks of a recording, finished or not; none where it cannot be read."""
    try:
        return open_run(path if path.exists() else path.with_name(path.name + PART_SUFFIX)).ticks
    except (OSError, RecordingError):
        return []
