"""The free swimmer of `fishctl simulate`: its options, its simulation and the printed report."""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from fishd.cli.controller_arguments import ControllerGroup
from fishd.cli.experiment_options import RUN_ONLY_OPTIONS, kept_arguments, restore_arguments
from fishd.cli.options import F, FiniteRange
from fishd.cli.output import echo, echo_rows, format_controller, format_speed, print_json
from fishd.cli.progress import show_progress
from fishd.core import files
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError, ParameterError
from fishd.core.process.interruption import on_signal

if TYPE_CHECKING:
    from fishd.config import Config
    from fishd.lab.swimmer.free_swim import SwimReport, SwimResult
    from fishd.virtual.swimmer.robot import Swimmer

DEFAULT_CHECKPOINT_INTERVAL_S = 5.0
DEFAULT_SETTLE_S = 8.0
"""Time that a swimmer needs from rest to a steady speed, roughly [s]."""


_RUN_ONLY_OPTIONS = RUN_ONLY_OPTIONS | dict.fromkeys(
    ("--to", "--save", "--checkpoint", "--film", "--record"), 1
)
"""Options that a resumed swim does not take over, and the number of words after each."""


class FreeSwimOptions(NamedTuple):
    """Values of the options that only a free swimmer has."""

    target: Path | None
    """File of the swim: .npz, or .csv without midlines and state."""
    checkpoint_every: float
    resume: Path | None
    film: Path | None

    def refuse(self) -> None:
        """Raise `UsageError` if one of them was given; call this for a tethered fish."""
        for option, path in (
            ("--to", self.target),
            ("--resume", self.resume),
            ("--film", self.film),
        ):
            if path is not None:
                raise click.UsageError(
                    f"{option} is for robot: swimmer, such as --config config/swimmer.yaml; the "
                    "simulation of a tethered fish is short, and --record writes its ticks"
                )

    def check(self) -> None:
        """Raise `ParameterError` if a file cannot or must not be written."""
        for path in (self.target, self.film):
            if path is not None:
                _check_writable(path)
        target = self.target
        if (
            target
            and os.path.lexists(target)
            and not (self.resume and target.resolve() == self.resume.resolve())
        ):
            raise ParameterError(f"{target} exists: --resume it, or give another file")


def _check_writable(path: Path) -> None:
    if not path.name:
        raise ParameterError("the name of a file is empty")
    try:
        files.check_writable(path)
    except files.FileProblem as problem:
        raise ParameterError(f"{path}: {problem}") from None


def free_swim_options(function: F) -> F:
    """Add `--to`, `--checkpoint-every`, `--resume` and `--film`."""

    def file_option(*names: str, about: str) -> Callable[[F], F]:
        return click.option(
            *names,
            type=click.Path(path_type=Path, dir_okay=False),
            metavar="FILE",
            help=f"For a swimmer: {about}",
        )

    decorators: list[Callable[[Any], Any]] = [
        file_option("--film", about="paint its wake while it swims: a .webp or .gif file."),
        file_option(
            "--resume",
            about="continue the swim in this .npz file, in the same file and with the same "
            "options, to the length of --for; with a CONTROLLER, begin another swim where that one "
            "ended.",
        ),
        click.option(
            "--checkpoint-every",
            type=FiniteRange(min=0.1),
            default=DEFAULT_CHECKPOINT_INTERVAL_S,
            show_default=True,
            help="For a swimmer: simulated time between two writes of the .npz file [s].",
        ),
        file_option(
            "--to",
            "target",
            about="write its track, midlines and state for --resume to this new .npz file, also "
            "at Ctrl-C; or its track alone to a .csv file.",
        ),
    ]
    for decorator in decorators:
        function = decorator(function)
    return function


class SimulateGroup(ControllerGroup):
    """The verb `simulate`, for which `--resume` restores the options of a swim in a file."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments after those of the resumed swim."""
        return super().parse_args(
            ctx, restore_arguments(ctx, args, _read_command, _RUN_ONLY_OPTIONS)
        )


def _read_command(_: click.Context, path: Path) -> list[str]:
    from fishd.virtual.swimmer import checkpoint

    return [*checkpoint.load(path).command, "--to", str(path)]


def swim(arguments: tuple[Any, ...], options: FreeSwimOptions, as_json: bool) -> int:
    """Swim, and print the report; return the exit status.

    arguments: configuration, controller, parameters, seconds, settle time, publisher, begun
    Raises `FishdError` and OSError.
    """
    from fishd.lab.swimmer.free_swim import SwimFile
    from fishd.lab.swimmer.free_swim import swim as run
    from fishd.virtual.swimmer import checkpoint, track

    target = options.target
    if target:
        track.check_name(target)
    options.check()
    command = kept_arguments(click.get_current_context())
    file = (
        SwimFile(target, options.checkpoint_every, command)
        if target and target.suffix == ".npz"
        else None
    )
    resume = checkpoint.load(options.resume) if options.resume else None
    interrupted = threading.Event()
    with (
        on_signal(interrupted.set),
        _open_film(arguments[0], options) as film,
        show_progress(arguments[3], "s", err=as_json) as bar,
    ):
        outcome = run(
            *arguments,
            progress=lambda passed, speed: bar.at(passed, f"{speed * 1e3:.1f} mm/s"),
            file=file,
            resume=resume,
            ended=interrupted.is_set,
            watch=film,
            lost=lambda error: bar.warn(
                f"fishctl: {target}: the swim cannot be written: {error.strerror or error}; the "
                "fish swims on"
            ),
        )
    is_unsaved = False
    if target and not file and len(outcome.track):
        try:
            track.save_table(outcome.track, target)
        except OSError as error:
            is_unsaved = True
            reason = error.strerror or error
            echo(f"fishctl: {target}: the track cannot be written: {reason}", err=True)
    if outcome.report and as_json:
        print_json(outcome.report)
    elif outcome.report:
        echo_rows(_report_rows(outcome.report))
    if outcome.error:
        raise FishdError(f"{outcome.error}; {_describe_checkpoint(outcome, options)}")
    if not outcome.complete:
        echo(f"fishctl: interrupted; {_describe_checkpoint(outcome, options)}", err=True)
        return INTERRUPTED
    report = outcome.report
    if report and report.fallback:
        echo(f"fishctl: another controller took over: {report.fallback.message}", err=True)
    if report and report.reason:
        echo(f"fishctl: the run ended in mode {report.mode}: {report.reason.message}", err=True)
        return 1
    return 1 if is_unsaved or outcome.checkpoint_error else 0


@contextmanager
def _open_film(config: "Config", options: FreeSwimOptions) -> "Iterator[Callable[[Swimmer], None]]":
    """Yield a function that paints the fish if there is a film; the film is written at the end."""
    if options.film is None:
        yield lambda fish: None
        return
    from fishd.lab.swimmer.film import Film

    with Film(options.film, config.swimmer) as film:
        yield lambda fish: film.add_frame(fish.fish)


def _describe_checkpoint(outcome: "SwimResult", options: FreeSwimOptions) -> str:
    """Return a clause about the file from which the swim can be resumed."""
    if outcome.checkpoint_time is not None:
        return (
            f"its last checkpoint is at {outcome.checkpoint_time:.2f} s; resume with: "
            f"fishctl simulate --resume {options.target}"
        )
    if options.resume:
        return f"its last checkpoint is {options.resume}"
    return "no checkpoint was written" + ("" if options.target else ": --to FILE.npz writes one")


def _report_rows(report: "SwimReport") -> list[tuple[str, str]]:
    plural = "" if report.beats == 1 else "s"
    beats = f"over {report.beats} whole beat{plural}" if report.beats else "no whole beat"
    resumed = f", started again at {report.resumed:.2f} s" if report.resumed is not None else ""
    return [
        ("controller", f"{format_controller(report.controller, report.parameters)}{resumed}"),
        ("speed", f"{format_speed(report.speed, report.speed_ci95, report.grid_error)}, {beats}"),
        *_trend_rows(report),
        ("frequency", f"{report.frequency:.3f} Hz" if report.frequency else "–"),
        ("heading", f"{report.heading:+.3f} rad"),
        ("tail", f"{report.tail_width:.3f} lengths from side to side"),
        (
            "power",
            f"{report.muscle_power:.4g} W/m of the muscles, {report.water_power:.4g} W/m to the "
            f"water, {report.steering_power:.2g} W/m of the steering",
        ),
        ("cost", _format_or_dash(report.cost_of_transport, "{:.4g} J/(kg m)")),
        (
            "Strouhal",
            _format_or_dash(report.strouhal, "{:.3f}") + f", Reynolds {report.reynolds:.0f}",
        ),
        ("Froude", _format_or_dash(report.froude_efficiency, "{:.1%}")),
        (
            "timing",
            f"{report.seconds:.2f} s in {report.ticks} ticks, "
            f"{report.real_time_factor:.3g} × real time",
        ),
    ]


def _trend_rows(report: "SwimReport") -> list[tuple[str, str]]:
    """Return a warning row if the speed has a trend, as its interval is then invalid."""
    if report.speed_trend is None:
        return []
    direction = "speeding up" if report.speed_trend > 0.0 else "slowing down"
    share = f"{abs(report.speed_trend):.2%}".replace("%", " %/s")
    return [("", f"still {direction} by {share}: a longer --settle is needed")]


def _format_or_dash(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)
