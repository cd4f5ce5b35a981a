"""fishd's loop on a simulated fish in virtual time, and where its ticks go."""

from collections.abc import Mapping
from contextlib import ExitStack
from typing import Any, Self

import msgspec
from msgspec.structs import replace

from fishd import __version__
from fishd.assembly import build_loop, open_fish_in_virtual_time
from fishd.config import Config
from fishd.control.reporting import Publisher
from fishd.controllers import registry
from fishd.core.clock import VirtualClock, virtual_slots
from fishd.core.errors import ParameterError
from fishd.core.signals import Event, Tick
from fishd.virtual.plant.base import TrueWindow

LONGEST = 1e8
"""Runs are shorter than this [s]: three years."""


class EncodingPublisher:
    """Does the work of telemetry up to the socket, so that timing says what the robot would do."""

    def __init__(self) -> None:
        self._encode = msgspec.json.Encoder().encode

    def tick(self, tick: Tick) -> None:
        """Encode and drop."""
        self._encode(tick)

    def event(self, event: Event) -> None:
        """Encode and drop."""
        self._encode(event)


class KeepingPublisher:
    """Keeps every tick; what matters of the events is in them."""

    def __init__(self) -> None:
        self.ticks: list[Tick] = []

    def tick(self, tick: Tick) -> None:
        """Keep it."""
        self.ticks.append(tick)

    def event(self, event: Event) -> None:
        """Drop."""


class VirtualRun:
    """fishd's loop on a simulated fish in virtual time, a tick at a time; a context manager."""

    def __init__(self, config: Config, publisher: Publisher | None) -> None:
        """publisher: gets the record of every tick, and every event; with None, no record is made

        Raises `MissingPackage`.
        """
        self.config = config
        clock = VirtualClock()
        with ExitStack() as stack:
            fish = open_fish_in_virtual_time(config, stack)
            self.swimmer = fish.swimmer
            """The fish itself, where it swims freely."""
            self._take_window = fish.take_window
            self.loop = build_loop(config, fish.robot, clock, publisher)
            stack.callback(self.loop.close)
            self._stack = stack.pop_all()
        self._slots = virtual_slots(clock, config.tick)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the controller and the robot; may be called twice."""
        self._stack.close()

    def about(self) -> dict[str, str]:
        """What is to be known of this fishd: its robot and limits, and the unit of its forces."""
        loop = self.loop
        return {
            "version": __version__,
            "robot": loop.robot.name,
            "tick": str(loop.limits.tick),
            "amplitude_limit": str(loop.limits.amplitude),
            "lowest": str(loop.guard.lowest),
            "highest": str(loop.guard.highest),
            "force_unit": loop.robot.force_unit,
        }

    def set_controller(self, name: str, parameters: Mapping[str, Any]) -> None:
        """Make a controller the active one, from the next tick on.

        Raises `UnknownController`, `ParameterError`, and `Refused` in mode fault.
        """
        limits = replace(self.config.limits, virtual=True)
        self.loop.set_controller(name, registry.create(name, parameters, limits))

    def tick(self) -> TrueWindow:
        """One tick; what truly happened between its read and the one before."""
        self.loop.tick(next(self._slots))
        return self._take_window()


def check_length(what: str, seconds: float) -> None:
    """Raise `ParameterError` where a length of time is not possible; what: what it is of."""
    if not 0.0 <= seconds < LONGEST:  # NaN is not
        raise ParameterError(
            f"a {what} of {seconds:g} s is not possible: a number from 0 to {LONGEST:g} s is needed"
        )
