"""Measurement of the fin angle in a video file, for `fishctl camera measure VIDEO`."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import click
import numpy as np
from msgspec import Struct

from fishd.cli.options import F, FiniteRange, plot_option
from fishd.cli.output import echo, echo_rows, format_count, print_json
from fishd.cli.progress import Lines, show_progress, show_waiting
from fishd.core import text
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError
from fishd.core.process.interruption import raise_on_first_signal
from fishd.core.tail_reading import MIDLINE_POINTS

if TYPE_CHECKING:
    from fishd.camera.latency import Force
    from fishd.camera.tail.learned import Learned
    from fishd.camera.tail.lens import Turn
    from fishd.camera.video import Video, VideoPicture
    from fishd.camera.video_table import VideoTable
    from fishd.core.tail_reading import TailReading
    from fishd.lab.fin_angle_figure import Example
    from fishd.lab.video_clock import ClockOffset

WARM_UP_S = 2.0
"""Part of a video that is measured again when its measurement is resumed [s]."""
_MAX_REASONS = 4
"""Largest number of reasons for unknown fin angles that are printed."""

_COLUMNS = ("video_time", "fin_angle", "fin_angle_uncertainty", "tip_column", "tip_row", "reason")
_MM_COLUMNS = ("tip_along_mm", "tip_across_mm")

Knowledge = TypeVar("Knowledge", bound=Struct)


class VideoOptions(NamedTuple):
    """Values of the options that only a video has."""

    rate: float | None
    turn: "Turn | None"
    learned: Path | None
    lens: Path | None
    recording: str | None
    length_mm: float | None
    target: Path | None
    picture: Path | None
    free: bool | None
    tag: int | None
    read_out_ms: float | None
    has_midline: bool | None

    def refuse(self) -> None:
        """Raise `UsageError` if one of them was given; call this without a video."""
        for parameter in click.get_current_context().command.params:
            if getattr(self, parameter.name or "", None) is not None:
                raise click.UsageError(f"{parameter.opts[0]} is for a VIDEO")


def video_options(function: F) -> F:
    """Add the options of `VideoOptions`."""

    def file_option(*names: str, about: str) -> Callable[[F], F]:
        path = click.Path(path_type=Path, dir_okay=False)
        return click.option(*names, type=path, metavar="FILE", help=f"For a VIDEO: {about}")

    positive = FiniteRange(min=0.0, max=1e5, min_open=True)
    decorators: list[Callable[[Any], Any]] = [
        click.option(
            "--midline",
            "has_midline",
            is_flag=True,
            default=None,
            help=f"For a VIDEO: add {MIDLINE_POINTS} points of the midline to the table, from "
            "root, or head, to tip.",
        ),
        click.option(
            "--read-out",
            "read_out_ms",
            type=FiniteRange(min=0.0, max=200.0),
            metavar="MS",
            help="For a VIDEO: time from the exposure of a picture's first row to that of its last "
            "one, of a rolling shutter [ms; default: 0].",
        ),
        click.option(
            "--tag",
            type=click.IntRange(0, 586),
            metavar="ID",
            help="With --free: AprilTag 36h11 on the back, whose side is --length, and whose upper "
            "edge is towards the head; it gives place and heading.",
        ),
        click.option(
            "--free",
            is_flag=True,
            default=None,
            help="For a VIDEO: the whole fish swims; measure its place, heading, speed, tail beat "
            "and Strouhal number. --length is that of the fish.",
        ),
        plot_option("for a VIDEO: a picture with the midline, and the motion over time,"),
        file_option("--to", "target", about="write the table, a row a picture, to this .csv file."),
        click.option(
            "--length",
            "length_mm",
            type=positive,
            metavar="MM",
            help="For a VIDEO: length of the tail in the water, from where it begins to move to "
            "its tip, for the place of the tip in millimetres.",
        ),
        click.option(
            "--with",
            "recording",
            metavar="RUN",
            help="For a VIDEO: recording of the same swim, as for 'fishctl export'; the "
            "lateral forces give its clock.",
        ),
        file_option(
            "--learned",
            about="tail that was learned before, by fishd-camera or with --learn, which writes it.",
        ),
        file_option("--lens", about="calibration of its lens, by 'fishctl camera lens'."),
        click.option(
            "--rotate",
            "turn",
            type=click.Choice([0, 90, 180, 270]),
            help="For a VIDEO: clockwise turn after which the head is at the left [degrees].",
        ),
        click.option(
            "--rate",
            type=positive,
            metavar="HZ",
            help="For a VIDEO: pictures a second, instead of the times in the file.",
        ),
    ]
    for decorator in decorators:
        function = decorator(function)
    return function


def name_midline(unit: str) -> tuple[str, ...]:
    """Return the names of the columns of a midline: all along the rows, then all across."""
    return tuple(f"{axis}{point}_{unit}" for axis in "xy" for point in range(MIDLINE_POINTS))


@contextmanager
def open_table(
    path: Path, options: VideoOptions, kind: type[Knowledge]
) -> "Iterator[tuple[Video, VideoTable[Knowledge]]]":
    """Yield a video and its unfinished table.

    kind: of what is learned from the video before it is measured
    """
    from fishd.camera.video import Video
    from fishd.camera.video_table import VideoTable
    from fishd.lab import drawing

    if options.target is None:
        raise click.UsageError("--to FILE.csv is needed for the table of a VIDEO")
    if options.picture:
        drawing.check(options.picture)
    turn, read_out = options.turn or 0, 1e-3 * (options.read_out_ms or 0.0)
    with Video(path, options.rate, turn, read_out) as video:
        status = path.stat()
        source = {"video": str(path.resolve()), "size": status.st_size}
        source |= {"modified": status.st_mtime_ns, "turn": turn}
        for name in ("rate", "read_out_ms", "length_mm", "free", "tag", "has_midline"):
            source[name] = getattr(options, name)
        with VideoTable(options.target, source, kind) as table:
            yield video, table


@contextmanager
def resumable(table: "VideoTable[Any]") -> Iterator[None]:
    """End the verb after Ctrl-C, and say that the same command goes on."""
    try:
        with raise_on_first_signal():
            yield
    except KeyboardInterrupt:
        done = f"{table.rows} pictures are measured; the same command goes on"
        echo(f"fishctl: interrupted, {done}", err=True)
        raise click.exceptions.Exit(INTERRUPTED) from None


def add_rows(
    video: "Video",
    table: "VideoTable[Any]",
    measure: "Callable[[VideoPicture], Sequence[str]]",
    warm_up: float = 0.0,
) -> None:
    """Add the missing rows to a table; warm_up: time before them to measure again [s]."""
    with ExitStack() as stack:
        show = Lines(err=True)
        if video.count:
            show = stack.enter_context(show_progress(video.count, "pictures", err=True))
        for picture in video.pictures(max(0, table.rows - round(warm_up * video.rate))):
            row = measure(picture)
            if picture.number >= table.rows:
                table.add(row)
            show.at(picture.number + 1)
    if table.rows < video.count - video.rate:
        echo(
            f"fishctl: {video.shown} ends after {table.rows} of {video.count} pictures: it is "
            "damaged",
            err=True,
        )


def measure_video(path: Path, options: VideoOptions, *, learn: bool, as_json: bool) -> int:
    """Measure the fin angle in each picture, write the table and print the result.

    learn: whether the tail is learned from this video and written to `options.learned`
    """
    from fishd.camera.tail.beats import average, find_maxima
    from fishd.camera.tail.learned import Learned

    if learn and options.learned is None:
        raise click.UsageError("--learn needs --learned FILE for what is learned from a VIDEO")
    clock: ClockOffset | None = None
    with open_table(path, options, Learned) as (video, table):
        forces = _read_recording(options.recording) if options.recording else None
        with resumable(table):
            learned = _find_learned(video, table, options, learn=learn)
            table.begin(learned)
            examples = _measure_pictures(video, table, learned)
        (times, angles), reasons = table.read_numbers((0, 1), reason=5)
        columns = _COLUMNS + (_MM_COLUMNS if learned.pixels_per_mm else ())
        columns += name_midline("px") if options.has_midline else ()
        rows: Iterable[list[str]] = table.read()
        if forces:
            from fishd.lab.video_clock import NoOffset, find_offset

            try:
                clock = find_offset(times, angles, forces)
            except NoOffset as error:
                raise NoOffset(
                    f"{text.quoted(options.recording or '')}: {error}; without --with, the same "
                    "command writes the table"
                ) from None
            columns += ("elapsed",)
            elapsed = clock.to_recording(times)
            rows = ([*row, f"{moment:.6f}"] for row, moment in zip(rows, elapsed, strict=True))
        beats = find_maxima(times.tolist(), angles.tolist())
        with resumable(table):
            if options.picture:  # first: without the unfinished table, nothing could go on
                from fishd.lab.fin_angle_figure import draw_fin_angle

                draw_fin_angle(path.name, times, angles, beats, examples, options.picture)
            table.finish(columns, rows)
    mean = average(beats)
    periods = np.diff([beat.time for beat in beats])
    # Between neighbours no beat is unknown.
    periods = periods[periods < [3.0 * (beat.back - beat.time) for beat in beats[:-1]]]
    frequency = 1.0 / float(np.median(periods)) if len(periods) else None
    known = int(np.count_nonzero(np.isfinite(angles)))
    begin, ci95 = clock.begin if clock else (None, None)
    if as_json:
        print_json(
            {
                "pictures": len(times),
                "known": known,
                "unknown": reasons,
                "zero_ci95": learned.zero_ci95,
                "fin_angle_max": mean and mean[0],
                "fin_angle_max_ci95": mean and mean[1],
                "beats": len(beats),
                "frequency": frequency,
                "video_begin": begin,
                "video_begin_ci95": ci95,
                "clock_stretch": clock and clock.stretch,
                "clock_stretch_ci95": clock and clock.stretch_ci95,
                "table": str(options.target),
            }
        )
        return 0
    size = f"{video.size[0]} × {video.size[1]} px"
    maximum = "fewer than two whole beats are seen"
    if mean:
        maximum = f"{text.format_measured(*mean, 'rad')} in {len(beats)} beats"
        maximum += f", {frequency:.3f} Hz" if frequency else ""
    lines = [
        ("video", f"{format_count(len(times), 'picture')} of {size}, {video.rate:.4g} a second"),
        ("fin angle", f"known in {known} of them, zero ± {learned.zero_ci95 * 1e3:.1f} mrad"),
        *(("", f"{count}: {why}") for why, count in reasons.most_common(_MAX_REASONS)),
        ("maximum", maximum),
    ]
    if clock:
        pace = "slow" if clock.stretch > 0.0 else "fast"
        percent = f"{100.0 * abs(clock.stretch):.3f} ± {100.0 * clock.stretch_ci95:.3f} %"
        lines += [
            (
                "recording",
                f"the video begins {begin:.4f} ± {ci95:.4f} s after its first tick",
            ),
            ("", f"the clock of the video is {percent} {pace}"),
        ]
    echo_rows([*lines, ("table", str(options.target))])
    return 0


def _read_recording(name: str) -> "list[Force]":
    """Return the forces of a recording, with times since its first tick."""
    from fishd.cli.camera.latency import force_windows
    from fishd.cli.recording.files import open_recording

    run = open_recording(name, None)
    ticks = run.ticks
    if len(ticks) < 2:
        raise FishdError(f"{run.path} contains no ticks to compare the video with")
    period = float(np.median(np.diff([tick.time for tick in ticks])))
    begin = ticks[0].time
    return [
        force._replace(begin=force.begin - begin, end=force.end - begin)
        for force in force_windows(ticks, period)
    ]


def _find_learned(
    video: "Video", table: "VideoTable[Learned]", options: VideoOptions, *, learn: bool
) -> "Learned":
    """Return the tail of the file, of the unfinished table, or learned from the video."""
    from fishd.camera.tail.learned import Learned
    from fishd.camera.tail.lens import Lens
    from fishd.camera.video import learn as learn_from

    lens = Lens.load(options.lens) if options.lens else None
    if lens:
        lens.check(video.size, options.turn or 0)
    if options.learned and not learn:
        learned = Learned.load(options.learned)
        learned.check_size(*video.size)
        if lens:
            learned.check_lens(lens)
        if learned.lens:
            learned.lens.check(video.size, options.turn or 0)
        return learned.with_length(options.length_mm)
    if table.learned:
        table.learned.check_lens(lens)
        return table.learned
    with show_waiting("learning the tail"):
        learned, begin = learn_from(video, lens)
    learned = learned.with_length(options.length_mm)
    echo(
        f"fishctl: the tail is learned from {begin:.0f} s of the video on, its zero is known to "
        f"± {learned.zero_ci95 * 1e3:.1f} mrad",
        err=True,
    )
    if options.learned:
        learned.save(options.learned)
    return learned


def _measure_pictures(
    video: "Video", table: "VideoTable[Learned]", learned: "Learned"
) -> "list[Example]":
    """Add the missing rows to a table; return the pictures with the largest angles."""
    from fishd.camera.tail.meter import TailMeter
    from fishd.lab.fin_angle_figure import Example

    meter, largest = TailMeter(learned), dict[int, Example]()

    def measure(picture: "VideoPicture") -> list[str]:
        reading = meter.read(picture.time, picture.pixels, *video.read_out)
        if reading.alpha is not None:
            side = 1 if reading.alpha > 0.0 else -1
            best = largest.get(side)
            if best is None or side * reading.alpha > side * (best.reading.alpha or 0.0):
                largest[side] = Example(picture.pixels, reading)
        return _to_row(reading, learned, has_midline=bool(table.source["has_midline"]))

    add_rows(video, table, measure, WARM_UP_S)
    return list(largest.values())


def _to_row(reading: "TailReading", learned: "Learned", *, has_midline: bool) -> list[str]:
    from fishd.camera.video_table import format_cell

    row = [format_cell(value, 6) for value in (reading.time, reading.alpha, reading.uncertainty)]
    row += [format_cell(value, 2) for value in reading.tip or (None, None)]
    row.append(reading.reason)
    if scale := learned.pixels_per_mm:
        places: Sequence[float | None] = (None, None)
        if reading.tip:
            places = (learned.to_axis(np.array(reading.tip)) / scale).tolist()
        row += [format_cell(value, 3) for value in places]
    if has_midline:
        points = np.array(reading.midline or [(math.nan, math.nan)] * MIDLINE_POINTS)
        row += [format_cell(value, 2) for value in points.T.ravel()]
    return row
