"""The verb that publishes a recording as if it were live."""

import shlex
from contextlib import suppress
from pathlib import Path

import click

from fishd.cli.options import FiniteRange, json_option
from fishd.cli.output import echo, format_count, print_json_line
from fishd.cli.recording.choice import folder_option, open_recording
from fishd.core.addresses import control_address, find_control_address
from fishd.core.process.interruption import raise_on_first_signal
from fishd.recording.replay import Replay

DEFAULT_ADDRESS = "tcp://127.0.0.1:9872"


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
    folder: Path | None,
    as_json: bool,
) -> None:
    """Publish a recording as fishd would, so that `fishctl watch` and PlotJuggler show it.

    RUN is a path, a name in the folder of recordings, or 'latest'. It ends with the recording, or
    with Ctrl-C. A gap of more than 5 s is shortened.
    """
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
