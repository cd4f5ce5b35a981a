"""The verbs about the file of a recording: export, plot, recover, replay; and its choice."""

import math
import shlex
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import click
from msgspec.structs import asdict

from fishd.cli.options import F, FiniteRange, json_option
from fishd.cli.output import echo, format_count, print_json, print_json_line, print_paths
from fishd.cli.verbs import pause_garbage_collector
from fishd.core import files
from fishd.core.addresses import control_address, find_control_address
from fishd.core.errors import FishdError
from fishd.core.process.interruption import raise_on_first_signal
from fishd.recording import Run, open_run
from fishd.recording.folder import (
    EXPERIMENT,
    FOLDER_VARIABLE,
    check_new_files,
    find_recording,
    list_recordings,
    runs_folder,
)
from fishd.recording.part_file import SUFFIX
from fishd.recording.reader import RECOVERED

if TYPE_CHECKING:
    from fishd.lab.run_traces import Traces


def _choose_folder(context: click.Context, _: click.Parameter, folder: Path | None) -> Path:
    """Return the folder of runs: of this verb, else of `fishctl runs --folder`."""
    given = context.parent.params.get("folder") if context.parent else None
    return folder or given or runs_folder()


folder_option = click.option(
    "--folder",
    type=click.Path(path_type=Path, file_okay=False),
    callback=_choose_folder,
    help="Folder with recordings, such as that of an experiment; default: "
    f"${FOLDER_VARIABLE}, else runs in the current folder.",
)
DEFAULT_ADDRESS = "tcp://127.0.0.1:9872"


def open_recording(name: str, folder: Path | None) -> Run:
    """Open the recording of a name; print on standard error what is wrong with its data or times.

    Raises `RecordingError`.
    """
    run = open_run(find_recording(name, folder))
    if run.problem:
        echo(f"fishctl: {run.path}: {run.problem}", err=True)
    for step in run.summary.clock_steps:
        echo(f"fishctl: {run.path}: {step}", err=True)
    return run


def _target_option(suffixes: str) -> Callable[[F], F]:
    return click.option(
        "--to",
        "target",
        type=click.Path(path_type=Path),
        metavar="FILE|FOLDER",
        help=f"File to write ({suffixes}), or a folder for files named after the recording. "
        "[default: beside the recording]",
    )


def _target_path(target: Path | None, run: Run, form: str | None) -> Path:
    """Return the file to write: the target, or in that folder a file of this format.

    target: None for the folder of the recording
    """
    target = target or run.path.parent
    if not target.is_dir():
        if form and target.suffix != f".{form}":
            raise click.UsageError(
                f"--{form}: --to {target} is a file of another format, or no folder"
            )
        return target
    if form is None:
        raise click.UsageError("--csv or --parquet is needed, or the name of a file for --to")
    return target / f"{run.name}.{form}"


@click.command()
@click.argument("run")
@click.option("--csv", "form", flag_value="csv", help="Write text, which every program reads.")
@click.option(
    "--parquet",
    "form",
    flag_value="parquet",
    help="Write Parquet, which is smaller and faster to read.",
)
@_target_option(".csv, .parquet")
@click.option("--force", is_flag=True, help="Replace existing files.")
@folder_option
@json_option
def export(
    run: str,
    form: str | None,
    target: Path | None,
    force: bool,
    folder: Path,
    as_json: bool,
) -> None:
    """Write a recording as tables: one row a tick, and a second file with its events.

    RUN is a path, a name in the folder of recordings, or 'latest'. All digits of a number are kept.
    """
    from fishd.recording.export import export as write

    recorded = open_recording(run, folder)
    path = _target_path(target, recorded, form)
    print_paths(write(recorded, path, replace=force), as_json)


@click.command()
@click.argument("runs", nargs=-1, required=True, metavar="RUN...")
@click.option(
    "--from", "begin", type=FiniteRange(min=0), default=0.0, help="Begin at this time [s]."
)
@click.option(
    "--until", "end", type=FiniteRange(min=0), help="End at this time [s]; default: the end."
)
@_target_option(".png, .svg, .pdf")
@click.option("--force", is_flag=True, help="Replace existing files.")
@folder_option
@json_option
@pause_garbage_collector()
def plot(
    runs: tuple[str, ...],
    begin: float,
    end: float | None,
    target: Path | None,
    force: bool,
    folder: Path,
    as_json: bool,
) -> None:
    """Draw forces, command, thrust, the controller's own quantities, and a phase portrait.

    RUN is a path, a name in the folder of recordings, or 'latest'. Of an experiment, its last
    recording is drawn; of a measurement, its drift and its thrust; of a training, its progress.
    Several runs are drawn over each other, each from the beginning of its swim; one without a
    recording is left out.
    """
    experiments = [_find_experiment(run, folder) for run in runs]
    if any(experiments) and (begin or end is not None):
        raise click.UsageError("--from and --until are for a recording, not an experiment")
    if len(runs) == 1 and (experiment := experiments[0]):
        path = _picture_path(target or experiment, experiment.name, force)
        _draw_experiment(experiment, path)
        print_paths([path], as_json)
        return
    drawn = list[tuple[str, "Traces"]]()
    left_out, first = list[str](), None
    for run, experiment in zip(runs, experiments, strict=True):
        name = experiment.name if experiment else run.rpartition("/")[2].removesuffix(SUFFIX)
        if recording := _open_plotted(run, experiment, folder):
            from fishd.lab.run_traces import traces  # takes long to load

            first = first or recording
            drawn.append((name, traces(recording, begin, math.inf if end is None else end)))
        else:
            left_out.append(name)
    if first is None:
        raise FishdError(f"nothing can be drawn: no recording in {', '.join(left_out)}")
    is_single = len(runs) == 1
    name = first.name if is_single else f"{first.name}-compared"
    path = _picture_path(target or first.path.parent, name, force)
    from fishd.lab.run_figure import draw_run, draw_runs

    if is_single:
        draw_run(drawn[0][1], path)
    else:
        draw_runs(drawn, left_out, path)
    print_paths([path], as_json)


def _picture_path(target: Path, name: str, force: bool) -> Path:
    """Return the file of a picture: the target, or this name in that folder."""
    path = target / f"{name}.png" if target.is_dir() else target
    check_new_files([path], replace=force)
    return path


def _find_experiment(run: str, folder: Path) -> Path | None:
    """Return the folder of an experiment; None for a recording."""
    path = files.expand_user(run) if "/" in run else folder / run
    return path if (path / EXPERIMENT).is_file() else None


def _open_plotted(run: str, experiment: Path | None, folder: Path) -> Run | None:
    """Open a recording, or the last one of an experiment; None for one without a recording."""
    if experiment is None:
        return open_recording(run, folder)
    recordings = list_recordings(experiment)
    return open_run(recordings[-1]) if recordings else None


def _draw_experiment(folder: Path, path: Path) -> None:
    from fishd.lab.experiment import read_header

    header = read_header(folder)
    if header.kind != "learn ppo":
        from fishd.lab import experiment_figure

        experiment_figure.draw(folder, header, path)
        return
    from fishd.learning.run_folder import figure
    from fishd.learning.run_folder.tables import SEEDS

    (figure.draw_seeds if (folder / SEEDS).exists() else figure.draw)(path, folder)


@click.command()
@click.argument("file")
@folder_option
@json_option
def recover(file: str, folder: Path, as_json: bool) -> None:
    """Repair a recording that was cut off by a kill, a full disk or a power cut, or is damaged.

    FILE is a path, a name in the folder of recordings, or 'latest'. NAME.mcap.part becomes
    NAME.mcap; a file of another name stays unchanged, and NAME-recovered.mcap is written beside it.
    """
    from fishd.recording.recover import recover as finish

    run = finish(find_recording(file, folder))
    summary = run.summary
    if as_json:
        print_json({"path": str(run.path), "problem": run.problem, **asdict(summary)})
        return
    frames = f", {format_count(summary.frames, 'frame')}" if summary.frames else ""
    problem = f"; {run.problem.removeprefix(RECOVERED)}" if run.problem else ""
    echo(
        f"{run.path}: {summary.duration:.1f} s, {format_count(summary.ticks, 'tick')}, "
        f"{summary.lost_ticks} lost, {format_count(summary.events, 'event')}{frames}{problem}"
    )


@click.command()
@click.argument("run")
@click.option(
    "--speed",
    type=FiniteRange(0.01, 1000),
    default=1.0,
    show_default=True,
    help="Factor by which it is faster than the recording.",
)
@click.option(
    "--address",
    default=DEFAULT_ADDRESS,
    show_default=True,
    metavar="ADDRESS",
    help="Address at which ticks, events and statuses are published.",
)
@click.option(
    "--control",
    metavar="ADDRESS",
    help="Control address, for 'fishctl watch'; default: that of fishd.",
)
@folder_option
@json_option
def replay(
    run: str,
    speed: float,
    address: str,
    control: str | None,
    folder: Path,
    as_json: bool,
) -> None:
    """Publish a recording as fishd would, so that `fishctl watch` and PlotJuggler show it.

    RUN is a path, a name in the folder of recordings, or 'latest'. It ends with the recording, or
    with Ctrl-C. A gap of more than 5 s is shortened.
    """
    from fishd.recording.replay import Replay

    recorded = open_recording(run, folder)
    with (
        suppress(KeyboardInterrupt),
        raise_on_first_signal(),
        Replay(recorded, address, control or control_address()) as player,
    ):
        seconds = recorded.summary.duration / speed
        if as_json:
            addresses = {"telemetry": player.telemetry, "control": player.control}
            print_json_line({"name": recorded.name, "seconds": seconds, **addresses})
            player.play(speed)
            return
        echo(f"{recorded.name}: {seconds:.0f} s at {player.telemetry}; Ctrl-C ends it")
        if recorded.frame_heads:
            echo(f"its {format_count(len(recorded.frame_heads), 'frame')} of a camera are left out")
        is_default = find_control_address() == player.control
        endpoint = "" if is_default else f"--endpoint {shlex.quote(player.control)} "
        echo(f"watch it with: fishctl {endpoint}watch")
        player.play(speed)
