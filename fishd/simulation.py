"""A whole run in virtual time: the robot's own loop on a simulated fish, its ticks or a report."""

import math
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from fishd.assembly import build_loop, open_in_virtual_time
from fishd.config import Config, adopt, load
from fishd.control.reporting import Publisher
from fishd.controllers import registry
from fishd.controllers.base import Controller, amplitude_of
from fishd.core.clock import VirtualClock, virtual_slots
from fishd.core.errors import ParameterError
from fishd.core.frames import frame
from fishd.core.signals import Event, Reason, Tick
from fishd.hardware.base import Robot
from fishd.virtual.fish import SimulatedFish
from fishd.virtual.plant.optimum import best_square_wave
from fishd.virtual.plant.tethered import TrueWindow

if TYPE_CHECKING:
    from pandas import DataFrame

LONGEST = 1e8
"""Runs are shorter than this [s]: three years."""


class Report(Struct, frozen=True):
    """The result of a run. Forces are the plant's true ones, over whole beats once settled."""

    controller: str
    parameters: dict[str, Any]
    amplitude: float
    """Φ: that of the controller, and of the best square wave it is compared with [rad]."""
    mean_thrust: float
    """[N]"""
    frequency: float
    """Tail beats per second; 0 when the tail does not beat [Hz]."""
    half_beats: tuple[int, int]
    """The shortest and the longest half beat, in ticks; 0 when the tail does not beat."""
    fin_amplitude: float
    """Largest fin angle of each half beat, mean over half beats [rad]."""
    fullness: float
    """Mean |φ_c|/Φ: 1 where the command uses all of the amplitude all of the time."""
    squareness: float
    """Mean |φ_c| over the rms of φ_c: square wave 1, sine 0.900, triangle 0.866; 0 without any."""
    efficiency: float
    """`mean_thrust` over `best_square_thrust`; 0 where no square wave moves the fin at all."""
    best_square_thrust: float
    """What the best square wave at this amplitude gives [N]."""
    best_square_frequency: float
    """[Hz]"""
    ticks: int
    mode: str
    """Mode at the end."""
    reason: Reason | None
    """Why, when that is fault."""
    fallback: Reason | None
    """Why another controller took over, if one did."""
    successor: str | None
    """Which one that was."""
    took_over: float | None
    """When it took over [s]; the figures are its own where that was before the end of settling."""
    microseconds_per_tick: float
    """What one turn of the loop took on this machine, once settled [µs]."""
    real_time_factor: float
    """Virtual seconds per second, once settled."""


class Beats:
    """Adds up what the plant truly did over whole beats, from upward reversal to upward reversal.

    A run without a whole beat is judged over all its time.
    """

    def __init__(self) -> None:
        self._whole = _Sums()
        self._open = _Sums()
        self._began = False
        self._side = 0.0
        self._each: list[tuple[float, float]] = []  # impulse N s, duration s

    @property
    def count(self) -> int:
        """How many whole beats there were."""
        return len(self._each)

    def add(self, angle: float, window: TrueWindow) -> None:
        """Add a window; angle: the instruction angle during it [rad]."""
        side = math.copysign(1.0, angle) if angle else self._side
        if side != self._side and self._side:
            self._open.close_half()
            if side > 0.0:
                if self._began:
                    self._whole += self._open
                    self._each.append((self._open.impulse, self._open.duration))
                self._began = True
                self._open = _Sums()
        self._side = side
        self._open.add(angle, window)

    def means(self) -> "BeatMeans":
        """Means over the whole beats."""
        sums = self._whole
        frequency = 0.5 * sums.halves / sums.duration if sums.halves else 0.0
        if not sums.halves:
            sums = self._open
            sums.close_half()
        mean = sums.angle / sums.duration
        rms = math.sqrt(sums.angle_squared / sums.duration)
        return BeatMeans(
            thrust=sums.impulse / sums.duration,
            thrust_deviation=_deviation(self._each),
            frequency=frequency,
            fin_amplitude=sums.peaks / sums.halves,
            mean_angle=mean,
            squareness=mean / rms if rms else 0.0,
            half_beats=(sums.shortest, sums.longest) if frequency else (0, 0),
        )


class BeatMeans(NamedTuple):
    """Means over beats."""

    thrust: float  # N
    frequency: float  # Hz
    fin_amplitude: float  # rad
    mean_angle: float  # of |φ_c|, rad
    squareness: float  # mean |φ_c| over rms φ_c
    half_beats: tuple[int, int]  # shortest and longest, ticks
    thrust_deviation: float  # standard error of the thrust, by how beats differ, N; or NaN


def _deviation(beats: Sequence[tuple[float, float]]) -> float:
    """Standard error of impulse over duration, a ratio of two means; NaN for fewer than two beats.

    Cochran, Sampling Techniques, 3rd edition, equation 6.9.
    """
    n = len(beats)
    if n < 2:
        return math.nan
    duration = sum(lasts for _, lasts in beats)
    mean = sum(impulse for impulse, _ in beats) / duration
    squares = sum((impulse - mean * lasts) ** 2 for impulse, lasts in beats)
    return math.sqrt(squares * n / (n - 1)) / duration


class _Sums:
    def __init__(self) -> None:
        self.duration = self.impulse = self.peaks = self.angle = self.angle_squared = 0.0
        self.halves = 0
        self.shortest, self.longest = sys.maxsize, 0
        self._peak = 0.0
        self._ticks = 0

    def add(self, angle: float, window: TrueWindow) -> None:
        self.duration += window.duration
        self.impulse += window.thrust * window.duration
        self.angle += abs(angle) * window.duration
        self.angle_squared += angle**2 * window.duration
        self._peak = max(self._peak, window.fin_peak)
        self._ticks += 1

    def close_half(self) -> None:
        self.halves += 1
        self.peaks += self._peak
        self.shortest = min(self.shortest, self._ticks)
        self.longest = max(self.longest, self._ticks)
        self._peak = 0.0
        self._ticks = 0

    def __iadd__(self, other: "_Sums") -> "_Sums":
        for name in ("duration", "impulse", "peaks", "angle", "angle_squared", "halves"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.shortest = min(self.shortest, other.shortest)
        self.longest = max(self.longest, other.longest)
        return self


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

    def __init__(self, config: Config, publisher: Publisher) -> None:
        """publisher: gets the record of every tick, and every event"""
        self.config = config
        clock = VirtualClock()
        with ExitStack() as stack:
            robot, self._take_window = _swimmer(config, stack)
            self.loop = build_loop(config, robot, clock, publisher)
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


def _swimmer(config: Config, stack: ExitStack) -> tuple[Robot, Callable[[], TrueWindow]]:
    """What swims, and how to ask what it truly did since the last time."""
    if config.robot == "virtual-pi":
        robot, pi = open_in_virtual_time(config, stack)
        return robot, pi.tank.take_window
    fish = SimulatedFish(config.plant, config.simulation, config.tick)
    return fish.robot(), fish.take_window


def run(
    config: Config | str | os.PathLike[str] | None = None,
    controller: str = "swing",
    parameters: Mapping[str, Any] | None = None,
    seconds: float = 60.0,
    *,
    overrides: Mapping[str, Any] | None = None,
) -> "DataFrame":
    """Let a controller swim a simulated fish, and give its ticks as a table: see `frame`.

    config: a YAML file or what `fishd.config.load` made of one; None for the defaults
    overrides: keys in dotted form, such as `{"plant.xi": 0.9}`

    A controller that fails ends in mode `fault`, as on a robot: the column `mode` says so.
    Raises `ConfigError`, `UnknownController`, `ParameterError`, and `MissingPackage` without
    pandas (extra: lab).
    """
    _check_length("run", seconds)
    settings = [f"{key}={_spelled(value)}" for key, value in (overrides or {}).items()]
    if isinstance(config, Config):
        config = adopt(msgspec.to_builtins(config), settings) if settings else config
    else:
        config = load(config, settings)
    publisher = KeepingPublisher()
    with VirtualRun(config, publisher) as virtual:
        virtual.set_controller(controller, parameters or {})
        for _ in range(max(1, round(seconds / config.tick))):
            virtual.tick()
    return frame(publisher.ticks)


def _spelled(value: Any) -> str:
    """A value as YAML has it; a number of numpy, too."""
    return msgspec.json.encode(value.item() if hasattr(value, "item") else value).decode()


def _check_length(what: str, seconds: float) -> None:
    if not 0.0 <= seconds < LONGEST:  # NaN is not
        raise ParameterError(
            f"a {what} of {seconds:g} s is not possible: a number from 0 to {LONGEST:g} s is needed"
        )


def simulate(
    config: Config,
    name: str,
    parameters: Mapping[str, Any],
    seconds: float = 60.0,
    settle: float = 10.0,
    publisher: Publisher | None = None,
) -> Report:
    """Let a controller swim a simulated fish for `seconds`, and judge it after `settle` seconds.

    publisher: gets the record of every tick, and every event
    Raises `UnknownController` and `ParameterError`.
    """
    controller = registry.create(name, parameters, replace(config.limits, virtual=True))
    return judge(config, name, controller, seconds, settle, publisher or EncodingPublisher())


def judge(
    config: Config,
    name: str,
    controller: Controller[Any],
    seconds: float,
    settle: float,
    publisher: Publisher,
) -> Report:
    """As `simulate`, with a controller that is ready-made.

    publisher: gets the record of every tick
    Raises `ParameterError` where the lengths do not fit one another.
    """
    _check_length("run", seconds)
    _check_length("time to settle", settle)
    ticks = round(seconds / config.tick)
    first = math.ceil(settle / config.tick - 1e-9) + 1
    if first >= ticks:
        raise ParameterError(
            f"nothing is left to judge: a run of {seconds:g} s must be longer than the "
            f"{settle:g} s that it may take to settle"
        )
    beats = Beats()
    begun = 0.0
    took_over: float | None = None
    with VirtualRun(config, publisher) as virtual:
        virtual.loop.set_controller(name, controller)
        for index in range(ticks):
            if index == first:  # the first ticks build what later ones reuse
                begun = time.perf_counter()
            angle = virtual.loop.applied
            window = virtual.tick()
            if virtual.loop.active.fallback and took_over is None:
                took_over = index * config.tick
            if index >= first:
                beats.add(angle, window)
        elapsed = time.perf_counter() - begun
        loop = virtual.loop
        fallback = loop.active.fallback
        successor = loop.active.name if fallback else None

    amplitude = amplitude_of(controller.parameters, config.limits)
    best = best_square_wave(config.plant, amplitude)
    means = beats.means()
    return Report(
        controller=name,
        parameters=msgspec.structs.asdict(controller.parameters),
        amplitude=amplitude,
        mean_thrust=means.thrust,
        frequency=means.frequency,
        half_beats=means.half_beats,
        fin_amplitude=means.fin_amplitude,
        fullness=means.mean_angle / amplitude,
        squareness=means.squareness,
        efficiency=means.thrust / best.thrust if best.thrust > 0.0 else 0.0,
        best_square_thrust=best.thrust,
        best_square_frequency=best.frequency,
        ticks=ticks,
        mode=loop.supervisor.mode.value,
        reason=loop.supervisor.reason,
        fallback=fallback,
        successor=successor,
        took_over=took_over,
        microseconds_per_tick=elapsed / (ticks - first) * 1e6,
        real_time_factor=(ticks - first) * config.tick / elapsed,
    )
