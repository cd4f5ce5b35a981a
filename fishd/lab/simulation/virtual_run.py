"""The control loop of fishd on a simulated fish in virtual time; its ticks, also as a table."""

import dataclasses
import os
from collections.abc import Mapping
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Self

import msgspec
from msgspec.structs import replace

from fishd import __version__
from fishd.assembly import build_loop, open_fish_in_virtual_time
from fishd.config import Config, adopt, load
from fishd.controllers import registry
from fishd.core.clock import Slot, VirtualClock, virtual_slots
from fishd.core.dataframes import ticks_to_frame
from fishd.core.errors import ParameterError
from fishd.core.schema import Reading
from fishd.core.signals import Event, Publisher, Tick
from fishd.virtual.plant.base import TrueWindow

if TYPE_CHECKING:
    from pandas import DataFrame

MAX_RUN_S = 1e8
"""Upper limit of the length of a run [s]: three years."""


class EncodingPublisher:
    """A publisher that encodes messages and drops them, so that computing times match a robot's."""

    def __init__(self) -> None:
        self._encode = msgspec.json.Encoder().encode

    def tick(self, tick: Tick) -> None:
        """Encode and drop."""
        self._encode(tick)

    def event(self, event: Event) -> None:
        """Encode and drop."""
        self._encode(event)


class KeepingPublisher:
    """A publisher that stores the ticks and drops events."""

    def __init__(self, min_ticks: int | None = None) -> None:
        """min_ticks: number of latest ticks to keep at least; None for all ticks"""
        self.ticks: list[Tick] = []
        self._min_ticks = min_ticks

    def tick(self, tick: Tick) -> None:
        """Store a tick, and drop the oldest from time to time."""
        self.ticks.append(tick)
        if self._min_ticks and len(self.ticks) > 2 * self._min_ticks:
            del self.ticks[: -self._min_ticks]

    def event(self, event: Event) -> None:
        """Drop an event."""


class VirtualRun:
    """fishd's loop on a simulated fish in virtual time, a tick at a time; a context manager."""

    def __init__(
        self, config: Config, publisher: Publisher | None, *, metered: bool = True
    ) -> None:
        """
        publisher: receiver of every tick and event; None to create no messages
        metered: whether the loop reads the power of the servo; False is faster

        Raises `MissingPackage`.
        """
        self.config = config
        clock = VirtualClock()
        with ExitStack() as stack:
            robot, self.fish = open_fish_in_virtual_time(config, stack)
            """The fish itself, as `RobotKind.open` describes it."""
            if not metered:
                others = tuple(s for s in robot.sensors if "power" not in s.declared)
                robot = dataclasses.replace(robot, sensors=others)
            self.loop = build_loop(config, robot, clock, publisher)
            stack.callback(self.loop.close)
            self._stack = stack.pop_all()
        self._slots = virtual_slots(clock, config.tick)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the controller and the robot; may be called twice."""
        self._stack.close()

    def about(self) -> dict[str, str]:
        """Return the facts about this run for a recording: robot, limits, unit of forces."""
        loop = self.loop
        return {
            "version": __version__,
            "robot": loop.robot.name,
            "tick": str(loop.limits.tick),
            "amplitude_limit": str(loop.limits.amplitude),
            "lowest_angle": str(loop.guard.lowest),
            "highest_angle": str(loop.guard.highest),
            "force_unit": loop.robot.force_unit,
        }

    @property
    def readings(self) -> dict[str, Reading]:
        """Readings of the sensors by name, for a recording."""
        return self.loop.readings.declared

    def set_controller(self, name: str, parameters: Mapping[str, Any]) -> None:
        """Make a controller the active one, from the next tick on.

        Raises `UnknownController`, `ParameterError`, and `Refused` in mode fault.
        """
        limits = replace(self.config.limits, virtual=True)
        self.loop.set_controller(name, registry.create(name, parameters, limits))

    def next_slot(self) -> Slot:
        """Advance the clock by a tick, for a caller of both halves of a tick of the loop."""
        return next(self._slots)

    def tick(self) -> TrueWindow:
        """Run one tick; return the true motion between its read and the one before."""
        self.loop.tick(self.next_slot())
        window: TrueWindow = self.fish.take_window()
        return window


def check_length(what: str, seconds: float) -> None:
    """Raise `ParameterError` where a length of time is not possible; what: its noun."""
    if not 0.0 <= seconds < MAX_RUN_S:  # NaN is not
        raise ParameterError(
            f"a {what} of {seconds:g} s is not possible: a number from 0 to {MAX_RUN_S:g} s is "
            "needed"
        )


def run(
    config: Config | str | os.PathLike[str] | None = None,
    controller: str = "swing",
    parameters: Mapping[str, Any] | None = None,
    seconds: float = 60.0,
    *,
    overrides: Mapping[str, Any] | None = None,
) -> "DataFrame":
    """Swim a simulated fish with a controller; return its ticks as a table, see `ticks_to_frame`.

    config: path of a YAML file, or result of `fishd.config.load`; None for the defaults
    overrides: values by dotted key, such as `{"plant.xi": 0.9}`

    A controller that fails ends in mode `fault`, as on a robot: the column `mode` says so.
    Raises `ConfigError`, `UnknownController`, `ParameterError`, and `MissingPackage` without
    pandas (extra: lab).
    """
    check_length("run", seconds)
    settings = [f"{key}={_to_yaml(value)}" for key, value in (overrides or {}).items()]
    if isinstance(config, Config):
        config = adopt(msgspec.to_builtins(config), settings) if settings else config
    else:
        config = load(config, settings)
    publisher = KeepingPublisher()
    with VirtualRun(config, publisher) as virtual:
        virtual.set_controller(controller, parameters or {})
        for _ in range(max(1, round(seconds / config.tick))):
            virtual.tick()
    return ticks_to_frame(publisher.ticks)


def _to_yaml(value: Any) -> str:
    """Return a value, possibly a numpy number, as YAML text."""
    return msgspec.json.encode(value.item() if hasattr(value, "item") else value).decode()
