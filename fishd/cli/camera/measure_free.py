"""Motion of a fish that swims by itself in a video, for `fishctl camera measure VIDEO --free`."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from fishd.cli.camera.measure_video import (
    VideoOptions,
    add_rows,
    name_midline,
    open_table,
    resumable,
)
from fishd.cli.output import echo_rows, format_count, print_json
from fishd.cli.progress import show_waiting
from fishd.core.tail_reading import MIDLINE_POINTS

if TYPE_CHECKING:
    from fishd.camera.video import VideoPicture
    from fishd.camera.video_table import VideoTable
    from fishd.lab.free_fish import FreeGround, Seen, Swim

_REASON = 6
"""Place of the reason in a row of the unfinished table, after the numbers of `Seen`."""
_ENDS = tuple(_REASON + k * MIDLINE_POINTS + last for last in (1, MIDLINE_POINTS) for k in (0, 1))
"""Places of the columns and rows of both ends of the midline."""


def measure_free(path: Path, options: VideoOptions, *, as_json: bool) -> int:
    """Find the fish in each picture, write the table and print the result."""
    from fishd.lab.free_fish import FreeFish, FreeGround, NoSwim, describe_swim, learn_ground

    for name, value in (
        ("--learned", options.learned),
        ("--lens", options.lens),
        ("--with", options.recording),
    ):
        if value is not None:
            raise click.UsageError(f"{name} is for a fish whose tail is measured, without --free")
    example: tuple[VideoPicture, Seen] | None = None
    with open_table(path, options, FreeGround) as (video, table):

        def measure(picture: "VideoPicture") -> list[str]:
            nonlocal example
            seen = finder.find(picture)
            if not seen.reason:
                example = picture, seen
            return _to_row(seen)

        with resumable(table):
            if (ground := table.learned) is None:
                with show_waiting("learning the ground"):
                    ground = learn_ground(video)
                table.begin(ground)
            finder = FreeFish(ground, video, options.tag)
            add_rows(video, table, measure)
        numbers, reasons = table.read_numbers((*range(_REASON), *_ENDS), _REASON)
        is_tagged = options.tag is not None
        try:
            swim = describe_swim(numbers, reasons, options.length_mm, tagged=is_tagged)
        except NoSwim:  # the same command would find the same
            table.part.unlink()
            raise
        unit = swim.unit
        names = ["video_time", f"x_{unit}", f"y_{unit}", "heading", f"speed_{unit}", f"tail_{unit}"]
        names += ["reason", *(name_midline(unit) if options.has_midline else ())]
        with resumable(table):
            if options.picture:  # first: without the unfinished table, nothing could go on
                from fishd.lab.fin_angle_figure import draw_swim

                seen = example and (example[0].pixels, example[1])
                draw_swim(path.name, swim, seen, options.picture)
            table.finish(names, _to_rows(table, swim, options))
    pictures, known = len(swim.times), int(np.count_nonzero(np.isfinite(swim.tail)))
    if as_json:
        values: dict[str, Any] = {"pictures": pictures, "known": known, "unknown": reasons}
        values |= {"unit": unit, "length": swim.length, "table": str(table.path)}
        values |= {"beats": swim.beats, "problem": swim.problem or None}
        for name in ("mean_speed", "frequency", "excursion", "strouhal"):
            values[name], values[f"{name}_ci95"] = getattr(swim, name) or (None, None)
        print_json(values)
        return 0
    of = format_count(pictures, "picture")
    rows = [("fish", f"{swim.length:.1f} {unit} long, in {known} of {of}")]
    if swim.problem:
        rows.append(("tail beat", f"unknown: {swim.problem}"))
    else:
        strouhal = "unknown: the fish does not swim on"
        if swim.strouhal:
            strouhal = f"{_format(swim.strouhal, '')}(frequency × excursion / speed)"
        beats = format_count(swim.beats, "beat")
        rows += [
            ("speed", _format(swim.mean_speed, f"{unit}/s")),
            ("tail beat", f"{_format(swim.frequency, 'Hz')}, {beats}"),
            ("excursion", f"{_format(swim.excursion, unit)} from peak to peak"),
            ("Strouhal", strouhal),
        ]
    echo_rows([*rows, ("table", str(table.path))])
    return 0


def _format(value: tuple[float, float], unit: str) -> str:
    if math.isnan(value[1]):
        return f"{value[0]:.3g} {unit} (one beat: no interval)"
    digits = max(0, 1 - math.floor(math.log10(value[1]))) if value[1] > 0.0 else 3
    return f"{value[0]:.{digits}f} ± {value[1]:.{digits}f} {unit}"


def _to_row(seen: "Seen") -> list[str]:
    from fishd.camera.video_table import format_cell

    numbers = (seen.time, *seen.place, seen.axis, seen.length, seen.tag_side)
    cells = [format_cell(value, 6) for value in numbers]
    return [*cells, seen.reason, *(format_cell(value, 3) for value in seen.midline.T.ravel())]


def _to_rows(
    table: "VideoTable[FreeGround]", swim: "Swim", options: VideoOptions
) -> Iterator[list[str]]:
    """Yield the rows of the finished table."""
    from fishd.camera.video_table import format_cell

    columns = swim.times, *swim.places.T, swim.heading, swim.speed, swim.tail, swim.is_tail_first
    for row, values in zip(table.read(), zip(*columns, strict=True), strict=True):
        cells = [f"{values[0]:.6f}"]
        cells += ["" if math.isnan(value) else f"{value:.6g}" for value in values[1:-1]]
        cells.append(row[_REASON])
        if options.has_midline:  # from the head
            numbers = [float(cell or math.nan) for cell in row[_REASON + 1 :]]
            points = swim.scale * np.array(numbers).reshape(2, -1)
            points = points[:, ::-1] if values[-1] else points
            cells += [format_cell(value, 3) for value in points.ravel()]
        yield cells
