"""The verb that finds the axis of motion, and how to turn the camera."""

import math
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fishd.cli.camera.options import (
    Watcher,
    camera_option,
    check_png,
    find_fishd,
    format_yaml,
    open_session,
    png_option,
    refuse_lockstep,
)
from fishd.cli.options import FiniteRange, endpoint_option, for_option, json_option, take_option
from fishd.cli.output import echo, echo_rows, print_json
from fishd.cli.progress import show_progress
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError, NoDaemon

if TYPE_CHECKING:
    from fishd.camera.alignment import Alignment
    from fishd.camera.client import CameraClient
    from fishd.client import Fish
    from fishd.core.camera_frames import Frame

SWIM_REMEDY = "let it swim, with 'fishctl set-controller swing', or add --swim"


@click.command()
@camera_option
@endpoint_option
@take_option
@png_option()
@for_option("Duration of the search [s].", default=10.0, kind=FiniteRange(min=2.0, max=600.0))
@click.option("--swim", is_flag=True, help="Let the fish swim meanwhile; it rests afterwards.")
@json_option
def align(
    address: str | None,
    endpoint: str | None,
    png: Path | None,
    seconds: float,
    swim: bool,
    as_json: bool,
) -> int:
    """Find the axis of motion in frames, and how to turn the camera, or what to set.

    The fish must swim. Frames should show its axis along their middle row, its head to the left:
    then what a policy learns on one side applies to the other. The picture shows what moves, and
    the axis. Exit status: 0 if an axis was detected, wherever it lies.
    """
    from fishd.camera import drawing
    from fishd.camera.alignment import judge
    from fishd.camera.axis import find_motion
    from fishd.camera.client import CameraClient

    check_png(png)
    with ExitStack() as stack:
        fish = find_fishd(endpoint, stack)
        if swim and fish is None:
            raise NoDaemon("no fishd answers, so no fish can swim; leave --swim out")
        client = stack.enter_context(CameraClient(address, fish=fish if swim else None))
        settings = client.settings()
        try:
            if swim:
                assert fish
                frames = _film_swim(client, fish, seconds)
            else:
                _refuse_rest(client, fish, settings.source)
                frames = _collect_frames(client, seconds)
        except KeyboardInterrupt:
            echo("fishctl: interrupted: no axis was detected", err=True)
            return INTERRUPTED
        import numpy as np

        motion = find_motion(np.stack([frame.pixels for frame in frames]))
        state = client.status()
    alignment = judge(motion, (state.picture_height, state.picture_width), settings)
    if as_json:
        print_json(_to_json(alignment, len(frames)))
    else:
        _print_alignment(alignment, len(frames))
    if png:
        energy, axis = motion.energy, motion.axis
        picture = drawing.enlarge(drawing.draw_motion(energy))
        drawing.write_png(png, drawing.draw_axis(picture, axis, len(energy)))
        echo(f"{png}: what moves, and the axis", err=as_json)
    return 0


def _collect_frames(client: "CameraClient", seconds: float) -> list["Frame"]:
    """Return the frames of some seconds, by the camera's clock; raise `CameraLost`."""
    frames: list[Frame] = []
    with show_progress(seconds, "s") as bar:
        for frame in client.frames():
            frames.append(frame)
            elapsed = frame.time - frames[0].time
            if elapsed < 0.0:
                raise FishdError("the camera was started again meanwhile: try again")
            bar.at(elapsed)
            if elapsed >= seconds:
                return frames
    return frames


def _film_swim(client: "CameraClient", fish: "Fish", seconds: float) -> list["Frame"]:
    refuse_lockstep(client.state.virtual)
    with open_session(fish, seconds) as rig, show_progress(seconds, "s") as bar:
        watcher = Watcher(client, bar.at)
        with rig.heard_by(watcher):
            rig.swim("swing", {}, seconds)
    if not watcher.frames:
        client.check()
        raise FishdError(f"no frame has come from {client.state.frames} while it swam")
    return watcher.frames


def _refuse_rest(client: "CameraClient", fish: "Fish | None", source: str) -> None:
    """Raise `FishdError` if the fish is known to rest."""
    if fish is not None and source != "stream" and not client.state.virtual:
        mode = fish.status().mode
        if mode != "running":
            raise FishdError(f"the fish rests (mode {mode}), so nothing moves: {SWIM_REMEDY}")


def _print_alignment(alignment: "Alignment", frames: int) -> None:
    axis, place = alignment.motion.axis, alignment.place
    side = "below" if axis.offset >= 0.0 else "above"
    slope = "down" if axis.tilt >= 0.0 else "up"
    echo_rows(
        [
            ("offset", f"{abs(axis.offset):.1f} px {side} the middle row"),
            ("tilt", f"{abs(math.degrees(axis.tilt)):.1f}°, {slope} to the right"),
            (
                "motion",
                f"rows {place.top} to {place.bottom}, columns {place.left} to {place.right} of "
                f"{alignment.motion.energy.shape[1]}",
            ),
            ("from", f"{frames} frames"),
        ]
    )
    if alignment.is_aligned:
        echo("well aligned")
    for line in alignment.advice:
        echo(line)
    if alignment.settings:
        echo("write into the file of the camera:")
        echo(format_yaml(alignment.settings))
        options = " ".join(f"--set {key}={value}" for key, value in alignment.settings.items())
        echo(f"or try: fishd-camera {options}")


def _to_json(alignment: "Alignment", frames: int) -> dict[str, Any]:
    axis = alignment.motion.axis
    return {
        "offset": axis.offset,
        "tilt": axis.tilt,
        "motion": alignment.place._asdict(),
        "frames": frames,
        "is_certain": alignment.motion.is_certain,
        "is_aligned": alignment.is_aligned,
        "advice": alignment.advice,
        "settings": alignment.settings,
    }
