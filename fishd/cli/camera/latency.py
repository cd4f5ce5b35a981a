"""The verb that measures how old a camera's pictures are, against the lateral force."""

import math
from typing import TYPE_CHECKING, Any

import click

from fishd.cli.camera.options import Watcher, camera_option, refuse_lockstep, rig_of, yaml_of
from fishd.cli.options import FiniteRange, endpoint_option, for_option, json_option, take_option
from fishd.cli.output import echo, echo_rows, print_json
from fishd.cli.progress import showing
from fishd.client import Fish
from fishd.core.console import INTERRUPTED
from fishd.core.errors import FishdError

if TYPE_CHECKING:
    from fishd.camera.latency import Force, Latency
    from fishd.camera.settings import CameraSettings
    from fishd.core.signals import Tick

OLD = 0.1
"""Younger frames need no `camera.stack.delay`: what was measured learned as well without [s]."""
_GAP = 1.5
"""Windows that end further apart than so many periods do not adjoin."""


@click.command()
@camera_option
@endpoint_option
@take_option
@for_option("How long the fish swims [s].", default=40.0, kind=FiniteRange(min=15.0, max=600.0))
@json_option
def latency(address: str | None, endpoint: str | None, seconds: float, as_json: bool) -> int:
    """Measure the delay of the whole camera path, from light to frame, against the lateral force.

    The fish swims many frequencies (controller excitation) and rests afterwards. The forces tell
    where its tail is, without any parameter of the fish; the frames show it later: that is the
    delay, with its 95 % interval.
    """
    from fishd.camera.client import CameraClient
    from fishd.camera.latency import find_latency

    with Fish(endpoint) as fish, CameraClient(address, fish=fish) as client:
        refuse_lockstep(client.state.virtual)
        next(client.frames())  # before the fish moves
        settings = client.settings()
        try:
            with rig_of(fish, seconds) as rig, showing(seconds, "s") as bar:
                watcher = Watcher(client, bar.at)
                rig.listener = watcher
                rig.swim("excitation", {}, seconds)
        except KeyboardInterrupt:
            echo("fishctl: interrupted: the fish rests, nothing is measured", err=True)
            return INTERRUPTED
        clocks = client.offset().uncertainty
    found = find_latency(watcher.frames, forces_of(watcher.ticks, rig.tick))
    if as_json:
        print_json(_as_json(found, clocks, settings))
    else:
        _print(found, clocks, settings)
    return 0


def forces_of(ticks: list["Tick"], period: float) -> list["Force"]:
    """The window of each tick's mean force, on the clock of fishd.

    period: of the loop [s]; a window reaches back to the one before, but not over a gap
    """
    from fishd.camera.latency import Force

    if ticks and not ticks[-1].time:
        raise FishdError(
            "this fishd does not tell the times of its ticks: it is older than this fishctl"
        )
    forces: list[Force] = []
    for tick in ticks:
        between = period / max(1, tick.samples)
        end = tick.time - 1e-3 * tick.age_ms + 0.5 * between
        adjoins = forces and end - forces[-1].end < _GAP * period
        forces.append(Force(forces[-1].end if adjoins else end - period, end, tick.fy))
    return forces


def _print(found: "Latency", clocks: float, settings: "CameraSettings") -> None:
    error = f"± {found.error * 1e3:.1f} ms"
    echo_rows(
        [
            ("delay", f"{found.whole * 1e3:.1f} {error}, from exposure until the frame is there"),
            ("time stamps", f"{found.stamps * 1e3:+.1f} {error} late"),
            ("arrival", f"{found.arrival * 1e3:.1f} ms after its time stamp, 99 % within "
             f"{found.latest * 1e3:.1f} ms"),
            ("agreement", f"{found.agreement:.1%} of the force's motion, in {found.frames} frames"),
        ]
    )  # fmt: skip
    if clocks > 1e-3:
        echo(f"careful: the clocks of camera and fishd are known to ± {clocks * 1e3:.1f} ms only")
    for line in advice(found, settings):
        echo(line)


def stack_delay(found: "Latency") -> float:
    """What `camera.stack.delay` of a training should be [s]; 0 for frames younger than `OLD`.

    Almost every frame is there by then. In steps of 5 ms, as the interval of the delay is hardly
    smaller.
    """
    if found.stamps + found.latest <= OLD:
        return 0.0
    return math.ceil((found.stamps + found.latest) / 5e-3 - 1e-6) * 5e-3


def advice(found: "Latency", settings: "CameraSettings") -> list[str]:
    """What to write where, or that nothing is to be set; lines of YAML as they are pasted."""
    lines = []
    if abs(found.stamps) > max(found.error, 1e-3):
        if settings.source == "simulated":
            lines.append("the stamps of a simulated camera are exact: this is an error of the fit")
        else:
            key = f"{settings.source}.delay"
            delay = round(getattr(settings, settings.source).delay + found.stamps, 4)
            lines += ["write into the file of the camera:", yaml_of({key: delay})]
            lines.append(f"or try: fishd-camera --set {key}={delay}")
    else:
        lines.append("its time stamps are right: nothing to set in the camera")
    if delay := round(stack_delay(found), 3):
        lines.append(
            "frames come late; for frames of even distance, write into the file of a training, for "
            "--settings:"
        )
        lines.append(yaml_of({"camera.stack.delay": delay}))
    else:
        lines.append("young enough for learning: nothing to set in a training")
    return lines


def _as_json(found: "Latency", clocks: float, settings: "CameraSettings") -> dict[str, Any]:
    return {
        "delay": found.whole,
        "error": found.error,
        "stamps": found.stamps,
        "arrival": found.arrival,
        "latest": found.latest,
        "agreement": found.agreement,
        "frames": found.frames,
        "clocks": clocks,
        "stack_delay": round(stack_delay(found), 3),
        "advice": advice(found, settings),
    }
