"""The verb that measures the delay of a camera's pictures, against the lateral force."""

import math
from typing import TYPE_CHECKING, Any

import click

from fishd.cli.camera.options import (
    Watcher,
    camera_option,
    format_yaml,
    open_session,
    refuse_lockstep,
)
from fishd.cli.options import FiniteRange, endpoint_option, for_option, json_option, take_option
from fishd.cli.output import echo, echo_rows, print_json
from fishd.cli.progress import show_progress
from fishd.client import Fish
from fishd.core.console import INTERRUPTED

if TYPE_CHECKING:
    from fishd.camera.latency import Force, Latency
    from fishd.camera.settings import CameraSettings
    from fishd.core.signals import Tick

MAX_UNDELAYED_AGE_S = 0.1
"""Age of frames up to which training succeeds without `camera.stack.delay` [s]."""
_MIN_GAP_PERIODS = 1.5
"""Smallest distance between the ends of windows that leave a gap [periods]."""


@click.command()
@camera_option
@endpoint_option
@take_option
@for_option("Duration of the swim [s].", default=40.0, kind=FiniteRange(min=15.0, max=600.0))
@json_option
def latency(address: str | None, endpoint: str | None, seconds: float, as_json: bool) -> int:
    """Measure the delay of the whole camera path, from light to frame, against the lateral force.

    The fish swims many frequencies (controller excitation) and rests afterwards. The forces show
    where its tail is, whatever the parameters of the fish; the frames show it later: the
    difference is the delay, with its 95 % confidence interval.
    """
    from fishd.camera.client import CameraClient
    from fishd.camera.latency import find_latency

    with Fish(endpoint) as fish, CameraClient(address, fish=fish) as client:
        refuse_lockstep(client.state.virtual)
        next(client.frames())  # before the fish moves
        settings = client.settings()
        try:
            with open_session(fish, seconds) as rig, show_progress(seconds, "s") as bar:
                watcher = Watcher(client, bar.at)
                with rig.heard_by(watcher):
                    rig.swim("excitation", {}, seconds)
        except KeyboardInterrupt:
            echo("fishctl: interrupted: the fish rests, nothing is measured", err=True)
            return INTERRUPTED
        clock_error = client.offset().uncertainty
    delays = find_latency(watcher.frames, force_windows(watcher.ticks, rig.tick))
    if as_json:
        print_json(_to_json(delays, clock_error, settings))
    else:
        _print_latency(delays, clock_error, settings)
    return 0


def force_windows(ticks: list["Tick"], period: float) -> list["Force"]:
    """Return the mean force of each tick with its window, on the clock of fishd.

    period: period of the loop [s]; a window reaches back to the previous one, except over a gap
    """
    from fishd.camera.latency import Force

    forces: list[Force] = []
    for tick in ticks:
        sample_interval = period / max(1, tick.samples)
        end = tick.time - 1e-3 * tick.sample_age_ms + 0.5 * sample_interval
        adjoins = forces and end - forces[-1].end < _MIN_GAP_PERIODS * period
        forces.append(Force(forces[-1].end if adjoins else end - period, end, tick.fy))
    return forces


def _print_latency(delays: "Latency", clock_error: float, settings: "CameraSettings") -> None:
    error = f"± {delays.ci95 * 1e3:.1f} ms"
    echo_rows(
        [
            ("delay", f"{delays.total * 1e3:.1f} {error}, from exposure until the frame is there"),
            ("time stamps", f"{delays.stamps * 1e3:+.1f} {error} late"),
            ("arrival", f"{delays.arrival * 1e3:.1f} ms after its time stamp, 99 % within "
             f"{delays.latest * 1e3:.1f} ms"),
            ("agreement", f"{delays.agreement:.1%} of the force's motion, "
             f"in {delays.frames} frames"),
        ]
    )  # fmt: skip
    if clock_error > 1e-3:
        echo(
            f"careful: the clocks of camera and fishd are known to "
            f"± {clock_error * 1e3:.1f} ms only"
        )
    for line in suggest_settings(delays, settings):
        echo(line)


def suggest_stack_delay(delays: "Latency") -> float:
    """Return the best `camera.stack.delay` of a training [s]; 0 for young frames.

    Almost every frame has arrived by then. The result is a multiple of 5 ms, since the confidence
    interval of the delay is hardly smaller.
    """
    if delays.stamps + delays.latest <= MAX_UNDELAYED_AGE_S:
        return 0.0
    return math.ceil((delays.stamps + delays.latest) / 5e-3 - 1e-6) * 5e-3


def suggest_settings(delays: "Latency", settings: "CameraSettings") -> list[str]:
    """Return lines that say which settings to write into which file, in YAML, if any."""
    lines = []
    if abs(delays.stamps) > max(delays.ci95, 1e-3):
        if settings.source == "simulated":
            lines.append("the stamps of a simulated camera are exact: this is an error of the fit")
        else:
            key = f"{settings.source}.delay"
            delay = round(getattr(settings, settings.source).delay + delays.stamps, 4)
            lines += ["write into the file of the camera:", format_yaml({key: delay})]
            lines.append(f"or try: fishd-camera --set {key}={delay}")
    else:
        lines.append("its time stamps are right: nothing to set in the camera")
    if delay := round(suggest_stack_delay(delays), 3):
        lines.append(
            "frames come late; for frames of even distance, write into the file of a training, for "
            "--settings:"
        )
        lines.append(format_yaml({"camera.stack.delay": delay}))
    else:
        lines.append("young enough for learning: nothing to set in a training")
    return lines


def _to_json(delays: "Latency", clock_error: float, settings: "CameraSettings") -> dict[str, Any]:
    return {
        "delay": delays.total,
        "ci95": delays.ci95,
        "stamps": delays.stamps,
        "arrival": delays.arrival,
        "latest": delays.latest,
        "agreement": delays.agreement,
        "frames": delays.frames,
        "clock_error": clock_error,
        "stack_delay": round(suggest_stack_delay(delays), 3),
        "advice": suggest_settings(delays, settings),
    }
