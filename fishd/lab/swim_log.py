"""Log of the swims and rests that an experiment on a live fish has finished, to resume it."""

import logging
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from fishd.core import files
from fishd.core.errors import ConfigError, FishdError, RecordingError
from fishd.core.signals import Tick
from fishd.lab.experiment import Experiment
from fishd.lab.session import Replaced, concerns_one_controller
from fishd.recording.part_file import PART_SUFFIX
from fishd.recording.reader import open_run
from fishd.recording.writer import RunWriter

log = logging.getLogger(__name__)

REQUEST_COLUMNS = ("controller", "parameters", "seconds")
"""Columns of what the experiment requested; a rest has no controller."""
SWIMS = "swims.csv"
TICK_COLUMNS = ("ticks", "first_tick", "last_tick")
COLUMNS = (*REQUEST_COLUMNS, "failure", *TICK_COLUMNS, "recording")


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
        for number, row in enumerate(rows, 2):
            ticks = []
            if not row["failure"]:
                try:
                    count, first, last = (int(row[name]) for name in TICK_COLUMNS)
                    recorded = read_ticks(experiment.path / row["recording"])
                except ValueError as error:  # that of a path contains a zero byte
                    raise ConfigError(
                        f"{experiment.path / SWIMS}:{number}: {error}; delete this line and those "
                        "after it, to measure these swims again"
                    ) from None
                ticks = [tick for tick in recorded if first <= tick.seq <= last]
                if len(ticks) < count:  # the computer lost power
                    break
            self._finished.append((row, ticks))
        self._drop_after(len(self._finished), len(rows), f"{SWIMS} has ticks that no recording has")

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
            self._drop_after(self._passed, len(self._finished), "other swims are requested")
        try:
            ticks = swim()
        except FishdError as error:
            if concerns_one_controller(error):
                self._add(request, failure=str(error))
            raise
        self._writer.flush()  # the row promises that the ticks are in the recording
        self._add(request, ticks=len(ticks), first_tick=ticks[0].seq, last_tick=ticks[-1].seq)
        return self._in_order(ticks)

    def _drop_after(self, count: int, known: int, why: str) -> None:
        """Drop the rows after so many of those that are known, and say so: they are swum again.

        The table with them is kept beside the new one: their recording may come back.
        """
        if known > count:
            folder = self._experiment.path
            name = files.unused_name("dropped", lambda n: (folder / f"{n}-{SWIMS}").exists(), "-")
            self._experiment.write(f"{name}-{SWIMS}", (folder / SWIMS).read_bytes())
            again = "%s: %d swims and rests of the log are swum again; it is kept as %s-%s"
            log.warning(again, why, known - count, name, SWIMS)
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
