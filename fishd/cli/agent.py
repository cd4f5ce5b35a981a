"""The verb `agent`: a policy outside fishd swims the fish through the controller `remote`."""

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from importlib import import_module
from typing import TYPE_CHECKING

import click
import msgspec
from msgspec.structs import replace

from fishd.cli.completion import complete_policy
from fishd.cli.options import endpoint_option, for_option, json_option, take_option, verb_lease
from fishd.cli.output import echo, print_json_line
from fishd.client import Fish
from fishd.config import adopt
from fishd.core.errors import ControllerFault, PolicyError
from fishd.core.process.interruption import on_signal
from fishd.core.signals import Observation

if TYPE_CHECKING:
    from fishd.camera.live_sight import LiveSight
    from fishd.controllers.policy.runtime import Pilot
    from fishd.learning.links.fishd_link import FishdLink

CAMERA_LOST_AFTER_S = 2.0
"""Time without frames after which the camera counts as lost [s]."""
HAND_OVER_TIMEOUT_S = 20.0
"""Longest time for fishd to let another controller take over [s]."""
REPORT_INTERVAL_S = 1.0
"""Time between two printed lines [s]."""


@click.command()
@click.argument("policy", metavar="NAME|FILE", shell_complete=complete_policy)
@click.option(
    "--camera",
    metavar="ADDRESS",
    help="Request address of fishd-camera, for a policy that sees pictures. [default: "
    "$FISHD_CAMERA, else that of this machine]",
)
@click.option(
    "--agent",
    "address",
    metavar="ADDRESS",
    help="Address at which fishd reaches this program, such as tcp://192.168.1.20:9873, if fishd "
    "runs on another machine. [default: any free port of this one]",
)
@for_option("End by itself after this time [s]; by default Ctrl-C ends it.")
@endpoint_option
@take_option
@json_option
def agent(
    policy: str,
    camera: str | None,
    address: str | None,
    seconds: float | None,
    endpoint: str | None,
    as_json: bool,
) -> int:
    """Let a policy swim the fish of a running fishd, tick by tick, until Ctrl-C.

    The policy runs in this program, on the robot's computer or on another one, as the agent of
    fishd's controller `remote`. Policies that see pictures can swim only in this way; the pictures
    come from a running fishd-camera. Policies that see forces can swim in this way, too.

    Without frames for 0.25 s the fish waits at neutral; after 2 s the camera counts as lost.
    At the end, the fish is always at neutral. Exit status 1 if the policy does not fit the robot
    or the camera, or one of them is lost.
    """
    for package in ("onnx", "onnxruntime"):
        import_module(package)  # `Verbs` names the extra of a missing package
    from fishd.camera.live_sight import LiveSight
    from fishd.controllers.policy.runtime import Pilot
    from fishd.learning.links.fishd_link import FishdLink
    from fishd.learning.links.link import LinkLost

    stopping = threading.Event()
    with on_signal(stopping.set), Fish(endpoint) as fish, ExitStack() as stack:
        status = fish.status()
        unit = status.force_unit
        limits = replace(adopt(fish.config()).limits, readings=tuple(status.readings))
        pilot = Pilot(policy, limits)
        sight = None
        if pilot.card.pictures:
            with _name_policy_in_errors(policy):
                sight = stack.enter_context(LiveSight(camera, fish, pilot.card.pictures))
                sight.await_frames()
        elif camera:
            raise click.UsageError("--camera cannot be given here: this policy sees no pictures")
        link = stack.enter_context(closing(FishdLink(endpoint, *verb_lease(), address=address)))
        swim = _Swim(link, pilot, sight, unit, as_json)
        echo(f"{policy} swims; it sees {pilot.card.sees}; Ctrl-C ends it", err=as_json)
        try:
            with _name_policy_in_errors(policy):
                swim.run(stopping, seconds)
        except ControllerFault as fault:
            with suppress(LinkLost):  # another controller already swims, or no controller does
                link.pause(HAND_OVER_TIMEOUT_S)
            raise PolicyError(f"{policy}: {fault}; {_hand_over(fish, fault)}") from None
        finally:
            link.close()  # first: this sends the fish to neutral
        if sight and pilot.blind > CAMERA_LOST_AFTER_S:
            raise sight.lost()
    echo(f"the fish rests, after {swim.duration:.0f} s", err=as_json)
    return 0


@contextmanager
def _name_policy_in_errors(policy: str) -> Iterator[None]:
    """Put the name of the policy in front of the message of a `PolicyError`."""
    try:
        yield
    except PolicyError as error:
        raise PolicyError(f"{policy}: {error}") from None


def _hand_over(fish: Fish, fault: ControllerFault) -> str:
    """Let the successor take over, as fishd does itself; return what swims now, in words."""
    if fault.successor is None:
        return "the fish rests"
    name, controller = fault.successor
    fish.set_controller(name, **msgspec.structs.asdict(controller.parameters))
    return f"{name} swims on"


class _Swim:
    """One swim, from taking over the fish until its end."""

    def __init__(
        self,
        link: "FishdLink",
        pilot: "Pilot",
        sight: "LiveSight | None",
        unit: str,
        as_json: bool,
    ) -> None:
        """unit: unit of the forces"""
        self._as_json = as_json
        self._link, self._pilot, self._sight, self._unit = link, pilot, sight, unit
        self.duration = 0.0
        """Duration of the swim until now, by the clock of fishd [s]."""
        self._last_report_time = time.monotonic()
        self._angles: list[float] = []
        self._late_ticks = self._blind_ticks = 0
        """Ticks whose action was late, and ticks without frames, since the latest report."""

    def run(self, stopping: threading.Event, seconds: float | None) -> None:
        """Swim until `stopping` is set, or frames have been missing for too long.

        seconds: longest duration [s]; None for no end. Raises `LinkLost`, `CameraLost`,
            `PolicyError` and `ControllerFault`.
        """
        link, pilot = self._link, self._pilot
        observation = link.reset()
        start = observation.time
        while not stopping.is_set() and pilot.blind <= CAMERA_LOST_AFTER_S:
            frames = self._sight.look(observation.time) if self._sight else None
            was_waiting = pilot.waits
            angle = pilot.angle(observation, frames)
            if pilot.waits and not was_waiting:
                echo("no frames: the fish waits at neutral", err=True)
            elif was_waiting and not pilot.waits:
                echo("frames are back: it swims on", err=True)
            observation, late = link.step(angle)
            self.duration = observation.time - start
            self._angles.append(abs(observation.instruction_angle))
            self._late_ticks += late
            self._blind_ticks += pilot.blind > 0.0
            if time.monotonic() - self._last_report_time >= REPORT_INTERVAL_S:
                self._report(observation)
            if seconds is not None and self.duration >= seconds - 0.5 * link.tick:
                return

    def _report(self, observation: Observation) -> None:
        fullness = sum(self._angles) / len(self._angles) / self._pilot.card.amplitude
        if self._as_json:
            print_json_line(
                {
                    "seconds": self.duration,
                    "frequency": observation.frequency,
                    "thrust": observation.thrust,
                    "fullness": fullness,
                    "ticks_without_frames": self._blind_ticks,
                    "late_ticks": self._late_ticks,
                    "ticks": len(self._angles),
                }
            )
            self._start_next_report()
            return
        line = (
            f"{self.duration:6.1f} s  {observation.frequency:5.2f} Hz  "
            f"thrust {observation.thrust * 1e3:6.2f} m{self._unit}  |φ_c| {fullness:4.0%} of Φ"
        )
        if self._blind_ticks:
            line += f"  without frames: {self._blind_ticks} of {len(self._angles)} ticks"
        if self._late_ticks:
            line += f"  late: {self._late_ticks} ticks"
        echo(line)
        self._start_next_report()

    def _start_next_report(self) -> None:
        self._last_report_time, self._angles, self._late_ticks, self._blind_ticks = (
            time.monotonic(),
            [],
            0,
            0,
        )
