"""A whole run in virtual time: the loop of the robot, on a simulated fish, for its figures."""

import itertools
import math
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from fishd.build import build_loop
from fishd.clock import VirtualClock, VirtualTicker
from fishd.config import Config
from fishd.controllers import registry
from fishd.controllers.base import Controller, amplitude_of
from fishd.errors import ParameterError
from fishd.hardware.base import Robot
from fishd.hardware.simulated import SimulatedFish
from fishd.plant.optimum import best_square_wave
from fishd.plant.tethered import TrueWindow
from fishd.reporting import Publisher
from fishd.robots import open_in_virtual_time
from fishd.signals import Event, Reason, Tick

LONGEST = 1e8
"""Runs are shorter than this [s]: three years."""


class Report(Struct, frozen=True):
    """What a run came to. Forces are the plant's true ones, over whole beats once settled."""

    controller: str
    parameters: dict[str, Any]
    amplitude: float
    """Φ: that of the controller, and of the best square wave it is compared with [rad]."""
    mean_thrust: float
    """[N]"""
    frequency: float
    """Tail beats per second; 0 when the tail does not beat [Hz]."""
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
    """Why another controller took over, if one did; the figures are those of both."""
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

    def add(self, angle: float, window: TrueWindow) -> None:
        """Add a window in which the instruction angle `angle` [rad] was in force."""
        side = math.copysign(1.0, angle) if angle else self._side
        if side != self._side and self._side:
            self._open.close_half()
            if side > 0.0:
                if self._began:
                    self._whole += self._open
                self._began = True
                self._open = _Sums()
        self._side = side
        self._open.add(angle, window)

    def figures(self) -> "Figures":
        """What the beats came to."""
        sums = self._whole
        frequency = 0.5 * sums.halves / sums.duration if sums.halves else 0.0
        if not sums.halves:
            sums = self._open
            sums.close_half()
        mean = sums.angle / sums.duration
        rms = math.sqrt(sums.angle_squared / sums.duration)
        return Figures(
            thrust=sums.impulse / sums.duration,
            frequency=frequency,
            fin_amplitude=sums.peaks / sums.halves,
            mean_angle=mean,
            squareness=mean / rms if rms else 0.0,
        )


class Figures(NamedTuple):
    """Means over beats."""

    thrust: float  # N
    frequency: float  # Hz
    fin_amplitude: float  # rad
    mean_angle: float  # of |φ_c|, rad
    squareness: float  # mean |φ_c| over rms φ_c


class _Sums:
    def __init__(self) -> None:
        self.duration = self.impulse = self.peaks = self.angle = self.angle_squared = 0.0
        self.halves = 0
        self._peak = 0.0

    def add(self, angle: float, window: TrueWindow) -> None:
        self.duration += window.duration
        self.impulse += window.thrust * window.duration
        self.angle += abs(angle) * window.duration
        self.angle_squared += angle**2 * window.duration
        self._peak = max(self._peak, window.fin_peak)

    def close_half(self) -> None:
        self.halves += 1
        self.peaks += self._peak
        self._peak = 0.0

    def __iadd__(self, other: "_Sums") -> "_Sums":
        self.duration += other.duration
        self.impulse += other.impulse
        self.peaks += other.peaks
        self.angle += other.angle
        self.angle_squared += other.angle_squared
        self.halves += other.halves
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


def simulate(
    config: Config,
    name: str,
    parameters: Mapping[str, Any],
    seconds: float = 60.0,
    settle: float = 10.0,
) -> Report:
    """Let a controller swim a simulated fish for `seconds`, and judge it after `settle` seconds.

    Raises `UnknownController` and `ParameterError`.
    """
    controller = registry.create(name, parameters, replace(config.limits, virtual=True))
    return judge(config, name, controller, seconds, settle, EncodingPublisher())


def judge(
    config: Config,
    name: str,
    controller: Controller[Any],
    seconds: float,
    settle: float,
    publisher: Publisher,
) -> Report:
    """As `simulate`, with a controller that is ready made, or is no part of fishd.

    publisher: gets the record of every tick
    Raises `ParameterError` where the lengths do not fit one another.
    """
    if not (0.0 <= settle < LONGEST and 0.0 < seconds < LONGEST):  # neither is NaN, say
        raise ParameterError(
            f"a run of {seconds:g} s with {settle:g} s to settle: numbers from 0 to {LONGEST:g} s "
            "are needed"
        )
    ticks = round(seconds / config.tick)
    first = math.ceil(settle / config.tick - 1e-9) + 1
    if first >= ticks:
        raise ParameterError(
            f"nothing is left to judge: a run of {seconds:g} s must be longer than the "
            f"{settle:g} s that it may take to settle"
        )
    clock = VirtualClock()
    beats = Beats()
    begun = 0.0
    with ExitStack() as stack:
        robot, take_window = _swimmer(config, stack)
        loop = build_loop(config, robot, clock, publisher)
        stack.callback(loop.close)
        loop.set_controller(name, controller)
        for slot in itertools.islice(VirtualTicker(clock, config.tick), ticks):
            if slot.index == first:  # the first ticks build what later ones reuse
                begun = time.perf_counter()
            angle = loop.applied
            loop.tick(slot)
            window = take_window()
            if slot.index >= first:
                beats.add(angle, window)
        elapsed = time.perf_counter() - begun
        fallback = loop.fallback

    amplitude = amplitude_of(controller.parameters, config.limits)
    best = best_square_wave(config.plant, amplitude)
    figures = beats.figures()
    return Report(
        controller=name,
        parameters=msgspec.structs.asdict(controller.parameters),
        amplitude=amplitude,
        mean_thrust=figures.thrust,
        frequency=figures.frequency,
        fin_amplitude=figures.fin_amplitude,
        fullness=figures.mean_angle / amplitude,
        squareness=figures.squareness,
        efficiency=figures.thrust / best.thrust if best.thrust > 0.0 else 0.0,
        best_square_thrust=best.thrust,
        best_square_frequency=best.frequency,
        ticks=ticks,
        mode=loop.supervisor.mode.value,
        reason=loop.supervisor.reason,
        fallback=fallback,
        microseconds_per_tick=elapsed / (ticks - first) * 1e6,
        real_time_factor=(ticks - first) * config.tick / elapsed,
    )


def _swimmer(config: Config, stack: ExitStack) -> tuple[Robot, Callable[[], TrueWindow]]:
    """What swims, and how to ask what it truly did since the last time."""
    if config.robot == "virtual-pi":
        robot, pi = open_in_virtual_time(config, stack)
        return robot, pi.tank.take_window
    fish = SimulatedFish(config.plant, config.simulation, config.tick)
    return fish.robot(), fish.take_window
