"""The verb that publishes a recording as if it were live."""

from contextlib import suppress
from pathlib import Path

import click

from fishd.cli.output import echo
from fishd.cli.recording.record import folder_option
from fishd.core.addresses import control_address
from fishd.core.interruption import interrupted_once
from fishd.recording import open_run
from fishd.recording.folder import find
from fishd.recording.replay import Replay

TELEMETRY = "tcp://127.0.0.1:9872"


@click.command()
@click.argument("run")
@click.option(
    "--speed",
    type=click.FloatRange(0.01, 1000),
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
def replay(run: str, speed: float, address: str, control: str | None, folder: Path | None) -> None:
    """Publish a recording as fishd would, so that `fishctl watch` and PlotJuggler show it.

    RUN is a path, a name in the folder of recordings, or 'latest'. It ends with the recording, or
    with Ctrl-C. A silence of more than 5 s is cut short.
    """
    recorded = open_run(find(run, folder))
    with (
        suppress(KeyboardInterrupt),
        interrupted_once(),
        Replay(recorded, address, control or control_address()) as player,
    ):
        seconds = recorded.summary.duration / speed
        echo(f"{recorded.name}: {seconds:.0f} s at {player.telemetry}; Ctrl-C ends it")
        if control:
            echo(f"watch it with: fishctl --endpoint {control} watch")
        else:
            echo("watch it with: fishctl watch")
        player.play(speed)
