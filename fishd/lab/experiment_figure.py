"""Picture of an experiment that is drawn later, from the files in its folder."""

from collections.abc import Iterator
from pathlib import Path

import msgspec
from msgspec.structs import replace

from fishd.core import files
from fishd.core.errors import FishdError, ParameterError
from fishd.core.signals import Tick
from fishd.core.swim_plan import rest_settle_time
from fishd.lab import measurement_figure, tables
from fishd.lab.experiment import MAX_TABLE_BYTES, RESULT, Header
from fishd.lab.measurement import Summary, ThrustMeasurement, evaluate, to_samples
from fishd.lab.run_figure import draw_run
from fishd.lab.run_traces import traces
from fishd.lab.swim_log import SWIMS
from fishd.recording import open_run
from fishd.recording.folder import list_recordings


def draw(folder: Path, header: Header, path: Path) -> None:
    """Draw a measurement as `fishctl measure --plot` does, any other experiment's last recording.

    Raises `FishdError`, also for an experiment without a recording.
    """
    recordings = list_recordings(folder)
    if not recordings:
        raise FishdError(f"{folder}: nothing can be drawn: it contains no recording")
    measurement = _evaluate(folder, header, recordings) if header.kind == "measure" else None
    if measurement:
        measurement_figure.draw(measurement, header.config["tick"], path)
    else:
        draw_run(traces(open_run(recordings[-1])), path)


def _evaluate(folder: Path, header: Header, recordings: list[Path]) -> ThrustMeasurement | None:
    """Return a finished measurement with its data; None where its files do not have them."""
    try:
        content = files.read(folder / RESULT, MAX_TABLE_BYTES, "a result")
        summary = msgspec.json.decode(content, type=Summary)
        ticks = list(_read_ticks(folder, recordings))
        tick, settle = header.config["tick"], header.settings["settle"]
        measurement = evaluate(to_samples(ticks), tick, settle, rest_settle_time(settle))
    except (files.FileProblem, msgspec.MsgspecError, ParameterError, LookupError, ValueError):
        return None
    return replace(measurement, **msgspec.structs.asdict(summary), ticks=ticks)


def _read_ticks(folder: Path, recordings: list[Path]) -> Iterator[Tick]:
    """Yield the ticks of all swims and rests of a live fish, or of the only recording."""
    recorded = {path.name: open_run(path).ticks for path in recordings}
    if not (folder / SWIMS).exists():
        (ticks,) = recorded.values()
        yield from ticks
        return
    head, *rows = tables.read(folder / SWIMS, MAX_TABLE_BYTES)
    for row in rows:
        swim = dict(zip(head, row, strict=True))
        first, last = int(swim["first_tick"]), int(swim["last_tick"])
        yield from (tick for tick in recorded[swim["recording"]] if first <= tick.seq <= last)
