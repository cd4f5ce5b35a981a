"""The verb that publishes a recording as if it were live."""

import shlex
from contextlib import suppress
from pathlib import Path

import click

from fishd.cli.options import FiniteRange, json_option
from fishd.cli.output import counted, echo, print_json_line
from fishd.cli.recording.choice import folder_option, opened
from fishd.core.addresses import control_address, find_control
from fishd.core.process.interruption import interrupted_once
from fishd.recording.replay import Replay

TELEMETRY = "tcp://127.0.0.1:9872"


@click.command()
@click.argument("run")
@click.option(
    "--speed",
    type=FiniteRange(0.01, 1000),
    default=1.0,
    show_default=True,
    help="How much faster than it was recorded.",
)
@click.option(
    "--address",
    default=TELEMETRY,
    show_default=True,
    metavar="ADDRESS",
    help="Where ticks, events and statuses are published.",
)
@click.option(
    "--control",
    metavar="ADDRESS",
    help="Where 'fishctl watch' asks for the status; default: where fishd would be.",
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
    with Ctrl-C. A silence of more than 5 s is cut short.
    """
    recorded = opened(run, folder)
    with (
        suppress(KeyboardInterrupt),
        interrupted_once(),
        Replay(recorded, address, control or control_address()) as player,
    ):
        seconds = recorded.summary.duration / speed
        if as_json:
            where = {"telemetry": player.telemetry, "control": player.control}
            print_json_line({"name": recorded.name, "seconds": seconds, **where})
            player.play(speed)
            return
        echo(f"{recorded.name}: {seconds:.0f} s at {player.telemetry}; Ctrl-C ends it")
        if recorded.frame_heads:
            echo(f"its {counted(len(recorded.frame_heads), 'frame')} of a camera are left out")
        found = find_control() == player.control
        endpoint = "" if found else f"--endpoint {shlex.quote(player.control)} "
        echo(f"watch it with: fishctl {endpoint}watch")
        player.play(speed)
