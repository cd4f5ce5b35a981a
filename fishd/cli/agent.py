"""The verb that lets a policy swim a fishd from outside: the agent of its controller `remote`."""

import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from importlib import import_module
from typing import TYPE_CHECKING

import click
import msgspec

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
    from fishd.controllers.policy.pilot import Pilot
    from fishd.learning.env.fishd_link import FishdLink

GIVE_UP = 2.0
"""After so long without frames the camera counts as lost [s]."""
HAND_OVER = 20.0
"""How long fishd may take to let another controller take over [s]."""
REPORT = 1.0
"""Time between two lines [s]."""


@click.command()
@click.argument("policy", metavar="NAME|FILE", shell_complete=complete_policy)
@click.option(
    "--camera",
    metavar="ENDPOINT",
    help="Where fishd-camera takes requests, for a policy that sees pictures. [default: "
    "$FISHD_CAMERA, else that of this machine]",
)
@click.option(
    "--agent",
    "address",
    metavar="ADDRESS",
    help="Where fishd reaches this program, such as tcp://192.168.1.20:9873, where that is on "
    "another machine. [default: any free port of this one]",
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

    It chooses each angle in this program, as the agent of fishd's controller `remote`: on the
    robot's own computer or on another one. So a policy that sees pictures can swim, although fishd
    has no pictures: they come from a running fishd-camera. Policies that see forces swim, too.

    Without frames for 0.25 s the fish waits at neutral; after 2 s the camera counts as lost.
    However this ends, the fish is at neutral. Exit status 1 where the policy does not fit the robot
    or the camera, or one of them is lost.
    """
    for package in ("onnx", "onnxruntime"):
        import_module(package)  # one that is missing is named with its extra, see `Verbs`
    from fishd.camera.live_sight import LiveSight
    from fishd.controllers.policy.pilot import Pilot
    from fishd.learning.env.fishd_link import FishdLink
    from fishd.learning.env.link import LinkLost

    stopping = threading.Event()
    with on_signal(stopping.set), Fish(endpoint) as fish, ExitStack() as stack:
        unit = fish.status().force_unit
        pilot = Pilot(policy, adopt(fish.config()).limits)
        sight = None
        if pilot.card.pictures:
            with _named(policy):
                sight = stack.enter_context(LiveSight(camera, fish, pilot.card.pictures))
                sight.await_frames()
        elif camera:
            raise click.UsageError("--camera cannot be given here: this policy sees no pictures")
        link = stack.enter_context(closing(FishdLink(endpoint, *verb_lease(), address=address)))
        swim = _Swim(link, pilot, sight, unit, as_json)
        echo(f"{policy} swims; it sees {pilot.card.sees}; Ctrl-C ends it", err=as_json)
        try:
            with _named(policy):
                swim.run(stopping, seconds)
        except ControllerFault as fault:
            with suppress(LinkLost):  # another controller swims already, or none
                link.pause(HAND_OVER)
            raise PolicyError(f"{policy}: {fault}; {_hand_over(fish, fault)}") from None
        finally:
            link.close()  # neutral first, then whatever takes time
        if sight and pilot.blind > GIVE_UP:
            raise sight.lost()
    echo(f"the fish rests, after {swim.swum:.0f} s", err=as_json)
    return 0


@contextmanager
def _named(policy: str) -> Iterator[None]:
    """Let what a policy is refused for begin with its name."""
    try:
        yield
    except PolicyError as error:
        raise PolicyError(f"{policy}: {error}") from None


def _hand_over(fish: Fish, fault: ControllerFault) -> str:
    """Let another controller take over, as fishd does itself; who swims now."""
    if fault.successor is None:
        return "the fish rests"
    name, controller = fault.successor
    fish.set_controller(name, **msgspec.structs.asdict(controller.parameters))
    return f"{name} swims on"


class _Swim:
    """One swim, from the take-over of the fish until something ends it."""

    def __init__(
        self,
        link: "FishdLink",
        pilot: "Pilot",
        sight: "LiveSight | None",
        unit: str,
        as_json: bool,
    ) -> None:
        """unit: of the forces"""
        self._as_json = as_json
        self._link, self._pilot, self._sight, self._unit = link, pilot, sight, unit
        self.swum = 0.0
        """How long, by the clock of fishd [s]."""
        self._reported = time.monotonic()
        self._angles: list[float] = []
        self._lost = self._unseen = 0
        """Ticks without an action in time, and without frames, since the latest report."""

    def run(self, stopping: threading.Event, seconds: float | None) -> None:
        """Swim until told to stop, for so long, or until frames have been missing for too long.

        Raises `LinkLost`, `CameraLost`, `PolicyError` and `ControllerFault`.
        """
        link, pilot = self._link, self._pilot
        seen = link.reset()
        begun = seen.time
        while not stopping.is_set() and pilot.blind <= GIVE_UP:
            frames = self._sight.look(seen.time) if self._sight else None
            waited = pilot.waits
            angle = pilot.angle(seen, frames)
            if pilot.waits and not waited:
                echo("no frames: the fish waits at neutral", err=True)
            elif waited and not pilot.waits:
                echo("frames are back: it swims on", err=True)
            seen, lost, _ = link.step(angle)
            self.swum = seen.time - begun
            self._angles.append(abs(seen.instruction_angle))
            self._lost += lost
            self._unseen += pilot.blind > 0.0
            if time.monotonic() - self._reported >= REPORT:
                self._report(seen)
            if seconds is not None and self.swum >= seconds - 0.5 * link.tick:
                return

    def _report(self, seen: Observation) -> None:
        full = sum(self._angles) / len(self._angles) / self._pilot.card.amplitude
        if self._as_json:
            print_json_line(
                {
                    "seconds": self.swum,
                    "frequency": seen.frequency,
                    "thrust": seen.thrust,
                    "fullness": full,
                    "unseen": self._unseen,
                    "lost": self._lost,
                    "ticks": len(self._angles),
                }
            )
            self._begin_report()
            return
        line = (
            f"{self.swum:6.1f} s  {seen.frequency:5.2f} Hz  thrust {seen.thrust * 1e3:6.2f} "
            f"m{self._unit}  |φ_c| {full:4.0%} of Φ"
        )
        if self._unseen:
            line += f"  without frames: {self._unseen} of {len(self._angles)} ticks"
        if self._lost:
            line += f"  late: {self._lost} ticks"
        echo(line)
        self._begin_report()

    def _begin_report(self) -> None:
        self._reported, self._angles, self._lost, self._unseen = time.monotonic(), [], 0, 0
