"""The verbs about a camera above the tail, loaded when they are called (extra: camera)."""

import click

from fishd.cli.verbs import Verb, Verbs

VERBS = {
    "Look": {
        "status": Verb("camera.look", "status", "Show the state of the camera."),
        "view": Verb("camera.look", "view", "Write its picture into a PNG file."),
        "measure": Verb("camera.measure", "measure", "Show the fin angle, or learn the tail."),
        "page": Verb("camera.page", "page", "Show its picture on the page of the fish."),
    },
    "Set up": {
        "align": Verb("camera.align", "align", "Find the axis of motion, and how to turn it."),
        "lens": Verb("camera.lens", "lens", "Calibrate lens and view, with a printed board."),
        "latency": Verb("camera.latency", "latency", "Measure the delay of its pictures."),
    },
}


@click.group(cls=Verbs, verbs=VERBS)
def camera() -> None:
    """Show the picture of the camera above the tail, and set it up.

    These verbs talk to a running fishd-camera; `fishctl record --camera` records its frames.
    """
