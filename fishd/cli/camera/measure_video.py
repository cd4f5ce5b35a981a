"""Measurement of the fin angle in a video file, for `fishctl camera measure VIDEO`."""

import math
import re
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
import numpy as np
from numpy.typing import NDArray

from fishd.cli.options import F, FiniteRange, plot_option
from fishd.cli.output import echo, echo_rows, format_count, print_json
from fishd.cli.progress import Lines, show_progress, show_waiting
from fishd.core import text
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError
from fishd.core.process.interruption import raise_on_first_signal

if TYPE_CHECKING:
    from fishd.camera.latency import Force
    from fishd.camera.tail.learned import Learned
    from fishd.camera.tail.lens import Turn
    from fishd.camera.tail_table import TailTable
    from fishd.camera.video import Video
    from fishd.lab.fin_angle_figure import Example
    from fishd.lab.video_clock import ClockOffset

WARM_UP_S = 2.0
"""Part of a video that is measured again when its measurement is resumed [s]."""
_MAX_REASONS = 4
"""Largest number of reasons for unknown fin angles that are printed."""

Array = NDArray[np.float64]


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

    def refuse(self) -> None:
        """Raise `UsageError` if one of them was given; call this without a video."""
        for name, value in zip(_NAMES, self, strict=True):
            if value is not None:
                raise click.UsageError(f"{name} is for a VIDEO")


_NAMES = (
    "--rate",
    "--rotate",
    "--learned",
    "--lens",
    "--with",
    "--length",
    "--to",
    "--plot",
    "--free",
    "--tag",
)


def video_options(function: F) -> F:
    """Add the options of `VideoOptions`."""

    def file_option(*names: str, about: str) -> Callable[[F], F]:
        path = click.Path(path_type=Path, dir_okay=False)
        return click.option(*names, type=path, metavar="FILE", help=f"For a VIDEO: {about}")

    positive = FiniteRange(min=0.0, max=1e5, min_open=True)
    decorators: list[Callable[[Any], Any]] = [
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
        plot_option("for a VIDEO: fin angle, its maxima, and two pictures with the midline,"),
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


class _Measured(NamedTuple):
    """All fin angles of a video."""

    times: Array
    """Times of the pictures [s]."""
    angles: Array
    """Fin angles, NaN where unknown [rad]."""
    reasons: Counter[str]
    """Number of pictures by the reason why the angle is unknown."""


def measure_video(path: Path, options: VideoOptions, *, learn: bool, as_json: bool) -> int:
    """Measure the fin angle in each picture, write the table and print the result.

    learn: whether the tail is learned from this video and written to `options.learned`
    """
    from fishd.camera.tail_table import Source, TailTable
    from fishd.camera.video import Video
    from fishd.lab import drawing

    if options.target is None:
        raise click.UsageError("--to FILE.csv is needed for the table of a VIDEO")
    if learn and options.learned is None:
        raise click.UsageError("--learn needs --learned FILE for what is learned from a VIDEO")
    if options.picture:
        drawing.check(options.picture)
    forces = _read_recording(options.recording) if options.recording else None
    turn = options.turn or 0
    with ExitStack() as stack:
        video = stack.enter_context(Video(path, options.rate, turn))
        status = path.stat()
        source = Source(
            video=str(path.resolve()),
            size=status.st_size,
            modified=status.st_mtime_ns,
            rate=options.rate,
            turn=turn,
            length_mm=options.length_mm,
        )
        table = stack.enter_context(TailTable(options.target, source))
        try:
            with raise_on_first_signal():
                table.begin(_find_learned(video, table, options, learn=learn))
                examples = _measure_pictures(video, table)
        except KeyboardInterrupt:
            done = f"{table.rows} pictures are measured; the same command goes on"
            echo(f"fishctl: interrupted, {done}", err=True)
            return INTERRUPTED
        measured = _read_angles(table)
        clock = None
        if forces:
            from fishd.lab.video_clock import NoOffset, find_offset

            try:
                clock = find_offset(measured.times, measured.angles, forces)
            except NoOffset as error:
                raise NoOffset(
                    f"{text.quoted(options.recording or '')}: {error}; without --with, the same "
                    "command writes the table"
                ) from None
            table.finish(("elapsed",), partial(_to_elapsed, clock))
        else:
            table.finish()
        _print_result(video, table, measured, clock, options, examples, as_json=as_json)
    return 0


def _to_elapsed(clock: "ClockOffset", row: list[str]) -> list[str]:
    return [f"{float(clock.to_recording(np.array(float(row[0])))):.6f}"]


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
    video: "Video", table: "TailTable", options: VideoOptions, *, learn: bool
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


def _measure_pictures(video: "Video", table: "TailTable") -> "list[Example]":
    """Add the missing rows to a table; return the pictures with the largest angles."""
    from fishd.camera.tail.meter import TailMeter
    from fishd.lab.fin_angle_figure import Example

    assert table.learned
    meter, largest = TailMeter(table.learned), dict[int, Example]()
    begin = max(0, table.rows - round(WARM_UP_S * video.rate))
    with ExitStack() as stack:
        show = Lines(err=True)
        if video.count:
            show = stack.enter_context(show_progress(video.count, "pictures", err=True))
        for picture in video.pictures(begin):
            reading = meter.read(picture.time, picture.pixels)
            if picture.number >= table.rows:
                table.add(reading)
            show.at(picture.number + 1)
            if reading.alpha is not None:
                side = 1 if reading.alpha > 0.0 else -1
                best = largest.get(side)
                if best is None or side * reading.alpha > side * (best.reading.alpha or 0.0):
                    largest[side] = Example(picture.pixels, reading)
    if table.rows < video.count - video.rate:
        echo(
            f"fishctl: {video.shown} ends after {table.rows} of {video.count} pictures: it is "
            "damaged",
            err=True,
        )
    return list(largest.values())


def _read_angles(table: "TailTable") -> _Measured:
    times, angles, reasons = [], [], Counter[str]()
    for row in table.read():
        times.append(float(row[0]))
        angles.append(float(row[1]) if row[1] else math.nan)
        if not row[1]:
            reasons[re.sub(r"\d+", "…", row[5])] += 1
    return _Measured(np.array(times), np.array(angles), reasons)


def _print_result(
    video: "Video",
    table: "TailTable",
    measured: _Measured,
    clock: "ClockOffset | None",
    options: VideoOptions,
    examples: "list[Example]",
    *,
    as_json: bool,
) -> None:
    from fishd.camera.tail.beats import average, find_maxima

    assert table.learned
    times, angles = measured.times, measured.angles
    beats = find_maxima(times.tolist(), [None if math.isnan(a) else a for a in angles.tolist()])
    mean = average(beats)
    frequency = 1.0 / float(np.median(np.diff([beat.time for beat in beats]))) if mean else None
    if options.picture:
        from fishd.lab.fin_angle_figure import draw_fin_angle

        draw_fin_angle(video.path.name, times, angles, beats, examples, options.picture)
    known = int(np.count_nonzero(np.isfinite(angles)))
    if as_json:
        print_json(
            {
                "pictures": len(times),
                "known": known,
                "unknown": measured.reasons,
                "zero_ci95": table.learned.zero_ci95,
                "fin_angle_max": mean[0] if mean else None,
                "fin_angle_max_ci95": mean[1] if mean else None,
                "beats": len(beats),
                "frequency": frequency,
                "video_begin": clock.begin[0] if clock else None,
                "video_begin_ci95": clock.begin[1] if clock else None,
                "clock_stretch": clock.stretch if clock else None,
                "clock_stretch_ci95": clock.stretch_ci95 if clock else None,
                "table": str(table.path),
            }
        )
        return
    size = f"{video.size[0]} × {video.size[1]} px"
    rows = [
        ("video", f"{format_count(len(times), 'picture')} of {size}, {video.rate:.4g} a second"),
        ("fin angle", f"known in {known} of them, zero ± {table.learned.zero_ci95 * 1e3:.1f} mrad"),
        *(("", f"{count}: {why}") for why, count in measured.reasons.most_common(_MAX_REASONS)),
        (
            "maximum",
            f"{text.format_measured(*mean, 'rad')} in {len(beats)} beats, {frequency:.3f} Hz"
            if mean
            else "fewer than two whole beats are seen",
        ),
    ]
    if clock:
        begin, ci95 = clock.begin
        pace = "slow" if clock.stretch > 0.0 else "fast"
        percent = f"{100.0 * abs(clock.stretch):.3f} ± {100.0 * clock.stretch_ci95:.3f} %"
        rows += [
            ("recording", f"the video begins {begin:.4f} ± {ci95:.4f} s after its first tick"),
            ("", f"the clock of the video is {percent} {pace}"),
        ]
    echo_rows([*rows, ("table", str(table.path))])
