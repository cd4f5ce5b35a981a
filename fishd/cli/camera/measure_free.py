"""Motion of a fish that swims by itself in a video, for `fishctl camera measure VIDEO --free`."""

import csv
import io
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fishd.cli.camera.measure_video import VideoOptions
from fishd.cli.output import echo_rows, format_count, print_json
from fishd.cli.progress import show_progress, show_waiting
from fishd.core import files
from fishd.core.errors import FishdError

if TYPE_CHECKING:
    from fishd.lab.free_fish import Seen, Swim


def measure_free(path: Path, options: VideoOptions, *, as_json: bool) -> int:
    """Find the fish in each picture, write the table and print the result."""
    from fishd.camera.video import Video
    from fishd.lab.free_fish import FreeFish, describe_swim

    for name, value in (
        ("--learned", options.learned),
        ("--lens", options.lens),
        ("--with", options.recording),
        ("--plot", options.picture),
    ):
        if value is not None:
            raise click.UsageError(f"{name} is for a fish whose tail is measured, without --free")
    target = options.target
    if target is None:
        raise click.UsageError("--to FILE.csv is needed for the table of a VIDEO")
    try:
        files.check_writable(target)
    except files.FileProblem as problem:
        raise FishdError(f"{target}: {problem}") from None
    if target.exists():
        raise FishdError(f"{target} exists already: give another file with --to")
    with Video(path, options.rate, options.turn or 0) as video:
        with show_waiting("learning the ground"):
            finder = FreeFish(video, options.tag)
        seen = []
        with show_progress(max(video.count, 1), "pictures", err=True) as show:
            for picture in video.pictures():
                seen.append(finder.find(picture))
                show.at(picture.number + 1)
    swim = describe_swim(seen, options.length_mm, tagged=options.tag is not None)
    try:
        files.write_atomically(target, _to_csv(seen, swim), new=True)
    except OSError as error:
        raise FishdError(f"{target} cannot be written: {error.strerror or error}") from None
    known = sum(not each.reason for each in seen)
    if as_json:
        values = {"pictures": len(seen), "known": known, "beats": swim.beats, "unit": swim.unit}
        values |= {"length": swim.length, "table": str(target)}
        for name in ("mean_speed", "frequency", "excursion", "strouhal"):
            values[name], values[f"{name}_ci95"] = getattr(swim, name)
        print_json(values)
        return 0
    echo_rows(
        [
            ("fish", f"{swim.length:.1f} {swim.unit} long, in {known} of "
             f"{format_count(len(seen), 'picture')}"),
            ("speed", _format(swim.mean_speed, f"{swim.unit}/s")),
            ("tail beat", f"{_format(swim.frequency, 'Hz')}, {format_count(swim.beats, 'beat')}"),
            ("excursion", f"{_format(swim.excursion, swim.unit)} from peak to peak"),
            ("Strouhal", f"{_format(swim.strouhal, '')}(frequency × excursion / speed)"),
            ("table", str(target)),
        ]
    )  # fmt: skip
    return 0


def _format(value: tuple[float, float], unit: str) -> str:
    digits = max(0, 1 - math.floor(math.log10(value[1]))) if value[1] > 0.0 else 3
    return f"{value[0]:.{digits}f} ± {value[1]:.{digits}f} {unit}"


def _to_csv(seen: "list[Seen]", swim: "Swim") -> str:
    table = io.StringIO()
    writer, unit = csv.writer(table, lineterminator="\n"), swim.unit
    writer.writerow(
        [
            "video_time",
            f"x_{unit}",
            f"y_{unit}",
            "heading",
            f"speed_{unit}",
            f"tail_{unit}",
            "reason",
        ]
    )
    columns = swim.times, *swim.places.T, swim.heading, swim.speed, swim.tail
    for each, row in zip(seen, zip(*columns, strict=True), strict=True):
        cells = ["" if math.isnan(value) else f"{value:.6g}" for value in row[1:]]
        writer.writerow([f"{row[0]:.6f}", *cells, each.reason])
    return table.getvalue()
