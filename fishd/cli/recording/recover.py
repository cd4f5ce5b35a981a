"""The verb that repairs a recording that was cut off."""

from pathlib import Path

import click
from msgspec.structs import asdict

from fishd.cli.options import json_option
from fishd.cli.output import echo, format_count, print_json
from fishd.cli.recording.choice import folder_option, format_damage
from fishd.recording import open_run
from fishd.recording.folder import find_recording
from fishd.recording.recover import recover as finish


@click.command()
@click.argument("file")
@folder_option
@json_option
def recover(file: str, folder: Path | None, as_json: bool) -> None:
    """Repair a recording that was cut off by a kill, a full disk or a power cut, or is damaged.

    FILE is a path, a name in the folder of recordings, or 'latest'. NAME.mcap.part becomes
    NAME.mcap; a file of another name stays unchanged, and NAME-recovered.mcap is written beside it.
    """
    path = find_recording(file, folder)
    damaged = open_run(path)
    run = finish(path)
    summary = run.summary
    if as_json:
        lost = damaged.damaged if damaged.is_damaged else None
        print_json({"path": run.path, "damaged": lost, **asdict(summary)})
        return
    frames = f", {format_count(summary.frames, 'frame')}" if summary.frames else ""
    loss = (
        f"; {format_damage(damaged.damaged, damaged.damage_reason)}" if damaged.is_damaged else ""
    )
    echo(
        f"{run.path}: {summary.duration:.1f} s, {format_count(summary.ticks, 'tick')}, "
        f"{summary.lost} lost, {format_count(summary.events, 'event')}{frames}{loss}"
    )
