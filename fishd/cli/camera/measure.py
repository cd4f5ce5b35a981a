"""The verb that learns the tail, and shows the fin angle that the camera measures."""

import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fishd.cli.camera.measure_free import measure_free
from fishd.cli.camera.measure_video import VideoOptions, measure_video, video_options
from fishd.cli.camera.options import (
    camera_option,
    find_fishd,
    follow_commands,
    open_session,
    refuse_lockstep,
)
from fishd.cli.options import FiniteRange, endpoint_option, for_option, json_option, take_option
from fishd.cli.output import echo, echo_rows, print_json, print_json_line
from fishd.cli.progress import show_progress, show_waiting
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError

if TYPE_CHECKING:
    from fishd.camera.client import CameraClient
    from fishd.camera.messages import CameraState
    from fishd.client import Fish

SWIM_S = 10.0
"""Default duration of the swim from which the tail is learned [s]."""
REST_S = 3.0
"""Duration of the rest before it, after which the fin stands still [s]."""
SWIM_HZ = 1.0
"""Frequency of the swim [Hz]; the fin swings most near its resonance."""
LEARNING_TIMEOUT_S = 60.0
"""Longest time that the camera may compute [s]."""
MAX_ZERO_CI95_RAD = 0.005
"""Largest half-width of the interval of a zero that was learned at rest [rad]."""
SHOW_PERIOD_S = 1.0
"""Time between two lines [s]."""


@click.command()
@click.argument("video", required=False, type=click.Path(path_type=Path))
@camera_option
@endpoint_option
@take_option
@click.option(
    "--learn", is_flag=True, help="Let the fish rest and swim, and learn tail, axis and zero."
)
@for_option(
    f"Duration of the swim to learn from [default: {SWIM_S:g}], or end showing after this time "
    "[s]; by default Ctrl-C ends it.",
    kind=FiniteRange(min=1.0, max=90.0),
)
@video_options
@json_option
def measure(
    video: Path | None,
    address: str | None,
    endpoint: str | None,
    learn: bool,
    seconds: float | None,
    as_json: bool,
    **video_values: Any,
) -> int:
    """Show the fin angle that the camera measures, live; --learn teaches it the tail first.

    With a VIDEO of a fish from above, the camera is not needed: the tail is learned from the video,
    and the fin angle of each picture is written into a table. The same command resumes it.

    The fin angle is the direction of the straight part of the fin against the axis of the fish,
    minus that at rest. To learn it, the fish rests for 3 s, for the zero, and swims. A fish that
    swims under another client already is left alone; then the zero is the middle of its swing, and
    less certain. The camera keeps what it has learned, until it or the picture moves.
    """
    options = VideoOptions(**video_values)
    if video is not None:
        for name, value in (("--camera", address), ("--for", seconds)):
            if value is not None:
                raise click.UsageError(f"{name} is for a camera, not for a VIDEO")
        if options.tag is not None and not options.free:
            raise click.UsageError("--tag is for --free")
        if options.free:
            if learn:
                raise click.UsageError(
                    "--learn is for a fish whose tail is measured, without --free"
                )
            return measure_free(video, options, as_json=as_json)
        return measure_video(video, options, learn=learn, as_json=as_json)
    options.refuse()
    from fishd.camera.client import CameraClient

    with ExitStack() as stack:
        client = stack.enter_context(CameraClient(address, tail=not learn))
        if learn:
            refuse_lockstep(client.state.virtual)
            return _learn(client, find_fishd(endpoint, stack), seconds or SWIM_S, as_json)
        with suppress(KeyboardInterrupt):
            _show(client, endpoint, seconds, as_json)
    return 0


def _learn(client: "CameraClient", fish: "Fish | None", seconds: float, as_json: bool) -> int:
    client.poll(1.0)
    client.check()  # before the fish moves
    before, is_begun = client.status().tail_learned, False
    try:
        if fish is None or fish.status().mode == "running":
            client.requests.learn_tail()
            is_begun = True
            _watch_swim(client, seconds)
        else:
            with open_session(fish, REST_S + seconds) as rig:
                client.requests.learn_tail()  # after the lease: another client may learn
                is_begun = True
                rig.rest(REST_S)
                rig.swim("square", {"frequency": SWIM_HZ}, seconds)
    except (KeyboardInterrupt, FishdError) as error:
        with suppress(FishdError):  # a camera that is gone forgets, too
            if is_begun:
                client.requests.cancel_tail()
        if isinstance(error, FishdError):
            raise
        echo("fishctl: interrupted: nothing is learned", err=True)
        return INTERRUPTED
    state = client.requests.finish_tail()
    with show_waiting("the camera computes"):
        deadline = time.monotonic() + LEARNING_TIMEOUT_S
        while state.tail == "learning":
            if time.monotonic() > deadline:
                raise FishdError(f"the camera has not learned within {LEARNING_TIMEOUT_S:g} s")
            time.sleep(0.2)
            state = client.status()
    if state.tail_problem:
        raise FishdError(state.tail_problem)
    if state.tail_learned == before:
        raise FishdError("nothing is learned: another client has ended it; learn again")
    _print_learned(state, as_json)
    return 0


def _watch_swim(client: "CameraClient", seconds: float) -> None:
    echo(f"fishctl: the camera watches for {seconds:g} s how the fish swims", err=True)
    with show_progress(seconds, "s") as bar:
        start = time.monotonic()
        while (elapsed := time.monotonic() - start) < seconds:
            client.poll(0.1)
            client.check()
            bar.at(elapsed)


def _print_learned(state: "CameraState", as_json: bool) -> None:
    zero_ci95 = state.tail_zero_ci95 or 0.0
    if as_json:
        print_json({"learned": state.tail_learned, "zero_ci95": zero_ci95})
        return
    size = f"{state.picture_width} x {state.picture_height} px"
    rows = [
        ("learned", f"{state.tail_learned}, from pictures of {size}"),
        ("zero", f"± {zero_ci95 * 1e3:.1f} mrad"),
    ]
    if state.lens:
        rows.append(("lens", f"{state.lens}; if the camera has moved, calibrate again"))
    echo_rows(rows)
    if zero_ci95 > MAX_ZERO_CI95_RAD:
        echo("the fish was not seen at rest: end its swim, wait, and learn again for a better zero")
    echo("the camera measures from now on: fishctl camera measure shows it")


def _show(
    client: "CameraClient", endpoint: str | None, seconds: float | None, as_json: bool
) -> None:
    from fishd.camera.tail_watch import TailWatch

    client.state.refuse_unmeasured()
    watch, start, shown = TailWatch(), time.monotonic(), time.monotonic()
    with follow_commands(endpoint, client.state.boot_id, watch):
        while seconds is None or time.monotonic() - start < seconds:
            client.poll(0.1)
            client.check()
            for tail in client.take_tails():
                watch.add(tail)
                if as_json:
                    print_json_line(tail)
            if not as_json and time.monotonic() - shown >= SHOW_PERIOD_S:
                shown = time.monotonic()
                echo(watch.describe())
