"""The verb that records the frames of a camera together with the fish."""

from functools import partial
from pathlib import Path

import click

from fishd.cli.camera.options import camera_option
from fishd.cli.recording.record import record_one, recording_options
from fishd.recording import RunWriter


@click.command()
@recording_options
@camera_option
def record(
    run: str | None,
    endpoint: str | None,
    folder: Path | None,
    operator: str,
    subject: str,
    note: str,
    seconds: float | None,
    as_json: bool,
    address: str | None,
) -> None:
    """Record a running fish and the frames of the camera above it in one file.

    RUN is a name in the folder of recordings or a path; by default the date and time. As `fishctl
    record --camera`. If the camera is lost, the
    recording goes on; the loss is reported and counted.
    """
    from fishd.lab.camera_tap import CameraTap

    begin = partial(RunWriter, operator=operator, subject=subject, note=note)
    with CameraTap(address, endpoint) as camera:
        record_one(run, endpoint, folder, begin, seconds, as_json, camera)
