"""A fish that an experiment tells to swim and to rest: of a running fishd, or in virtual time."""

from collections.abc import Mapping
from contextlib import suppress
from typing import Any, Protocol, Self

from fishd.client import Fish
from fishd.config import Config
from fishd.core.errors import FishdError, FishError
from fishd.core.signals import Reason, Tick
from fishd.simulation import KeepingPublisher, VirtualRun


class Disturbed(FishdError):
    """The fish did not do what the experiment told it to; the message says what it did."""


class Replaced(Disturbed):
    """The controller gave up and another one took over, which the experiment did not ask for."""


class Rig(Protocol):
    """One fish, of which an experiment is in charge; a context manager that leaves it at rest."""

    name: str
    """What it is, such as `simulated` or `pi`."""
    tick: float
    """Period of its loop [s]."""
    amplitude: float
    """Φ [rad]"""
    unit: str
    """Of its forces: `N`, or that of its sensor until that is calibrated."""

    def __enter__(self) -> Self:
        """Nothing moves yet."""

    def __exit__(self, *_: object) -> None:
        """Leave the fish at rest."""

    def swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        """Let a controller swim from its start for so long; the ticks of that time, in order.

        Raises `Refused` for a controller that is not possible, and `Disturbed`.
        """

    def rest(self, seconds: float) -> list[Tick]:
        """Fade to neutral and stay there for so long; the ticks of that time, in order.

        Raises `Disturbed`.
        """


class VirtualRig:
    """A simulated fish in virtual time."""

    def __init__(self, config: Config) -> None:
        self.name = "simulation"
        self.unit = "N"
        self.tick = config.tick
        self.amplitude = config.amplitude_limit
        self._kept = KeepingPublisher()
        self._run = VirtualRun(config, self._kept)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._run.close()

    def swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        """As `Rig.swim`."""
        self._run.set_controller(controller, parameters)
        return self._pass(seconds, controller)

    def rest(self, seconds: float) -> list[Tick]:
        """As `Rig.rest`."""
        self._run.loop.stop()
        return self._pass(seconds, None)

    def _pass(self, seconds: float, controller: str | None) -> list[Tick]:
        ticks: list[Tick] = []
        self._kept.ticks = ticks
        for _ in range(max(1, round(seconds / self.tick))):
            self._run.tick()
            loop = self._run.loop
            _check(ticks[-1], controller, loop.supervisor.reason, loop.active.fallback)
        return ticks


class LiveRig:
    """The fish of a running fishd; its controller is ours until somebody else takes it."""

    def __init__(self, fish: Fish) -> None:
        """Raises `NoDaemon`."""
        status = fish.status()
        self.name = status.robot
        self.unit = status.force_unit
        self.tick = status.tick
        self.amplitude = status.amplitude_limit
        self._fish = fish
        self._ticks = fish.ticks()
        self._controller: str | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Stop what was begun here; what somebody else has begun since swims on."""
        if self._controller is None:
            return
        with suppress(FishError):
            status = self._fish.status()
            ours = status.controller == self._controller or status.fallback
            if status.mode == "running" and ours:
                self._fish.stop()

    def swim(self, controller: str, parameters: Mapping[str, Any], seconds: float) -> list[Tick]:
        """As `Rig.swim`; raises `NoDaemon` where fishd goes away."""
        state = self._fish.set_controller(controller, **parameters)
        self._controller = controller
        return self._pass(state.seq, seconds, controller)

    def rest(self, seconds: float) -> list[Tick]:
        """As `Rig.rest`; raises `NoDaemon` where fishd goes away."""
        state = self._fish.stop()
        self._controller = None
        return self._pass(state.seq, seconds, None)

    def _pass(self, first: int, seconds: float, controller: str | None) -> list[Tick]:
        ticks: list[Tick] = []
        count = max(1, round(seconds / self.tick))
        for tick in self._ticks:
            if not first <= tick.seq < first + 2 * count:  # of before, or of another fishd
                continue
            if not _as_told(tick, controller):
                status = self._fish.status()
                _check(tick, controller, status.reason, status.fallback)
            ticks.append(tick)
            if tick.seq >= first + count - 1:
                break
        return ticks


def _as_told(tick: Tick, controller: str | None) -> bool:
    if controller is None:
        return tick.mode == "idle"
    return (tick.mode, tick.controller) == ("running", controller)


def _check(
    tick: Tick, controller: str | None, reason: Reason | None, fallback: Reason | None
) -> None:
    """Raises `Disturbed` where the fish does another thing than it was told to.

    reason: why it is in mode fault or estop; fallback: why another controller took over
    """
    if _as_told(tick, controller):
        return
    told = f"told to let {controller} swim" if controller else "told to rest"
    cause = reason or fallback
    why = f" ({cause.message})" if cause else ""
    does = f"{tick.controller} swims" if tick.mode == "running" else f"it is in mode {tick.mode}"
    replaced = controller and fallback and tick.mode == "running"
    kind = Replaced if replaced else Disturbed
    raise kind(f"the fish was {told}, but {does}{why}: this measurement is lost")
