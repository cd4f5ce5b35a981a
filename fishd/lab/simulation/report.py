"""A run in virtual time with a report on the true motion and forces of the plant."""

import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from fishd.config import Config, check_tethered
from fishd.controllers import registry
from fishd.controllers.base import Controller, amplitude_of
from fishd.core.beats import Reversals
from fishd.core.errors import ParameterError
from fishd.core.signals import Publisher, Reason
from fishd.lab.simulation.virtual_run import VirtualRun, check_length
from fishd.virtual.plant.base import TrueWindow
from fishd.virtual.plant.optimum import best_square_wave


class Report(Struct, frozen=True):
    """Result of a run, with true forces of the plant, as means over whole settled beats."""

    controller: str
    parameters: dict[str, Any]
    amplitude: float
    """Amplitude Φ of the controller, and of the best square wave for comparison [rad]."""
    mean_thrust: float
    """Mean thrust [N]."""
    mean_power: float | None
    """Electrical power of the servo [W]; None for a plant without a motor."""
    frequency: float
    """Frequency of the tail beat [Hz]; 0 where the tail does not beat."""
    half_beats: tuple[int, int]
    """Length of the shortest and of the longest half beat [ticks]; 0 without tail beats."""
    reversals: int
    """Number of sign changes of the command, after settling."""
    fin_amplitude: float
    """Mean over half beats of the largest fin angle [rad]."""
    fullness: float
    """Mean |φ_c|/Φ: 1 where the command is always at full amplitude."""
    form_factor: float
    """Mean |φ_c| over the rms of φ_c: square wave 1, sine 0.900, triangle 0.866, no command 0."""
    relative_thrust: float
    """`mean_thrust` over `best_square_thrust`; 0 where no square wave moves the fin."""
    best_square_thrust: float
    """Mean thrust of the best square wave at this amplitude [N]."""
    best_square_frequency: float
    """Frequency of the best square wave [Hz]."""
    ticks: int
    mode: str
    """Mode at the end."""
    reason: Reason | None
    """Reason of mode fault."""
    fallback: Reason | None
    """Reason why the fallback took over; None if it did not."""
    successor: str | None
    """Name of the controller that took over; None if there was none."""
    quantities: dict[str, float]
    """Quantities of the controller at the end."""
    took_over_at: float | None
    """Time when the fallback took over [s]; if before settling, the figures are its own."""
    microseconds_per_tick: float
    """Mean computing time of a tick on this machine, after settling [µs]."""
    real_time_factor: float
    """Ratio of simulated time to computing time, after settling."""


def simulate(
    config: Config,
    name: str,
    parameters: Mapping[str, Any],
    seconds: float = 60.0,
    settle: float = 10.0,
    publisher: Publisher | None = None,
    on_start: Callable[[VirtualRun], None] = lambda run: None,
) -> Report:
    """Swim a simulated fish with a controller for `seconds`; report on the time after `settle` [s].

    publisher: receiver of every tick and event; None to create no messages
    on_start: called before the first tick
    Raises `UnknownController` and `ParameterError`.
    """
    controller = registry.create(name, parameters, replace(config.limits, virtual=True))
    return judge(config, name, controller, seconds, settle, publisher, on_start)


def count_ticks(seconds: float, settle: float, tick: float) -> tuple[int, int]:
    """Return the number of ticks of a run and of the first settled one.

    Raises `ParameterError` where the times are not possible.
    """
    check_length("run", seconds)
    check_length("time to settle", settle)
    ticks = round(seconds / tick)
    first = math.ceil(settle / tick - 1e-9) + 1
    if first >= ticks:
        raise ParameterError(
            f"a run of {seconds:g} s is too short: it must be longer than the settling time of "
            f"{settle:g} s"
        )
    return ticks, first


def check_whole_beat(report: Report, seconds: float, settle: float) -> None:
    """Raise `ParameterError` where the tail was reversed, but made less than a whole beat.

    The mean thrust over a part of a beat says nothing about a gait.
    """
    if report.reversals and not report.frequency:
        raise ParameterError(
            f"{report.controller}: no whole tail beat in the {seconds - settle:g} s after the "
            f"{settle:g} s of --settle, so the mean thrust is undefined; give a longer --for"
        )


def judge(
    config: Config,
    name: str,
    controller: Controller[Any],
    seconds: float,
    settle: float,
    publisher: Publisher | None,
    on_start: Callable[[VirtualRun], None] = lambda run: None,
) -> Report:
    """Swim a simulated fish with a controller object, and report as `simulate` does.

    publisher: receiver of every tick and event; None to create no messages
    on_start: called before the first tick
    Raises `ParameterError` where `settle` is too long, and `ConfigError` for a free fish.
    """
    check_tethered(config.robot, "relative_thrust")
    ticks, first = count_ticks(seconds, settle, config.tick)
    beats = Beats()
    since = 0.0
    took_over_at: float | None = None
    with VirtualRun(config, publisher) as virtual:
        on_start(virtual)
        virtual.loop.set_controller(name, controller)
        for index in range(ticks):
            if index == first:  # the first ticks are slower, as they fill caches
                since = time.perf_counter()
            angle = virtual.loop.instruction_angle
            window = virtual.tick()
            if virtual.loop.active.fallback and took_over_at is None:
                took_over_at = index * config.tick
            if index >= first:
                beats.add(angle, window)
        elapsed = time.perf_counter() - since
        loop = virtual.loop
        fallback = loop.active.fallback
        quantities = loop.active.quantities
        successor = loop.active.name if fallback else None

    amplitude = amplitude_of(controller.parameters, config.limits)
    best = best_square_wave(config.plant, amplitude)
    means = beats.means()
    return Report(
        controller=name,
        parameters=msgspec.structs.asdict(controller.parameters),
        amplitude=amplitude,
        mean_thrust=means.thrust,
        mean_power=means.power,
        frequency=means.frequency,
        half_beats=means.half_beats,
        reversals=beats.reversals,
        fin_amplitude=means.fin_amplitude,
        fullness=means.mean_angle / amplitude,
        form_factor=means.form_factor,
        relative_thrust=means.thrust / best.thrust if best.thrust > 0.0 else 0.0,
        best_square_thrust=best.thrust,
        best_square_frequency=best.frequency,
        ticks=ticks,
        mode=loop.supervisor.mode.value,
        reason=loop.supervisor.reason,
        fallback=fallback,
        successor=successor,
        quantities=quantities,
        took_over_at=took_over_at,
        microseconds_per_tick=elapsed / (ticks - first) * 1e6,
        real_time_factor=(ticks - first) * config.tick / elapsed,
    )


class Beats:
    """Sums of the true quantities of a plant over whole beats, between upward reversals.

    For a run without a whole beat, the sums cover all its time.
    """

    def __init__(self) -> None:
        self._whole_beats = _Sums()
        self._open_beat = _Sums()
        self._before_beats = _Sums()
        """Sums over the time before the first beat."""
        self.reversals = 0
        self._began = False
        self._reversals = Reversals()
        self._beats: list[tuple[float, float]] = []  # impulse N s, duration s

    @property
    def count(self) -> int:
        """Number of whole beats."""
        return len(self._beats)

    def add(self, angle: float, window: TrueWindow) -> None:
        """Add a window; angle: the instruction angle during it [rad]."""
        if reversal := self._reversals.add(angle):
            self._open_beat.close_half()
            self.reversals += 1
            if reversal > 0:
                if self._began:
                    self._whole_beats += self._open_beat
                    self._beats.append((self._open_beat.impulse, self._open_beat.duration))
                else:
                    self._before_beats = self._open_beat
                self._began = True
                self._open_beat = _Sums()
        self._open_beat.add(angle, window)

    def means(self) -> "BeatMeans":
        """Return the means over the whole beats."""
        sums = self._whole_beats
        frequency = 0.5 * sums.halves / sums.duration if sums.halves else 0.0
        if not sums.halves:
            self._open_beat.close_half()
            sums = self._before_beats
            sums += self._open_beat
        mean = sums.angle / sums.duration
        rms = math.sqrt(sums.angle_squared / sums.duration)
        return BeatMeans(
            thrust=sums.impulse / sums.duration,
            thrust_deviation=_thrust_standard_error(self._beats),
            frequency=frequency,
            fin_amplitude=sums.peaks / sums.halves,
            mean_angle=mean,
            form_factor=mean / rms if rms else 0.0,
            power=None if math.isnan(sums.energy) else sums.energy / sums.duration,
            half_beats=(sums.shortest, sums.longest) if frequency else (0, 0),
        )


class BeatMeans(NamedTuple):
    """Means over beats."""

    thrust: float  # N
    frequency: float  # Hz
    fin_amplitude: float  # rad
    mean_angle: float  # of |φ_c|, rad
    form_factor: float  # mean |φ_c| over rms φ_c
    power: float | None  # electrical, of the servo, W; None for a fish without a motor
    half_beats: tuple[int, int]  # shortest and longest, ticks
    thrust_deviation: float  # standard error of the thrust, from the spread of beats, N; or NaN


def _thrust_standard_error(beats: Sequence[tuple[float, float]]) -> float:
    """Return the standard error of total impulse over total duration; NaN for less than two beats.

    Cochran, Sampling Techniques, 3rd edition, equation 6.9.
    """
    n = len(beats)
    if n < 2:
        return math.nan
    duration = sum(length for _, length in beats)
    mean = sum(impulse for impulse, _ in beats) / duration
    squares = sum((impulse - mean * length) ** 2 for impulse, length in beats)
    return math.sqrt(squares * n / (n - 1)) / duration


class _Sums:
    def __init__(self) -> None:
        self.duration = self.impulse = self.peaks = self.angle = self.angle_squared = 0.0
        self.energy = 0.0
        self.halves = 0
        self.shortest, self.longest = sys.maxsize, 0
        self._peak = 0.0
        self._ticks = 0

    def add(self, angle: float, window: TrueWindow) -> None:
        duration = window.duration
        self.duration += duration
        self.impulse += window.thrust * duration
        self.energy += window.power * duration
        self.angle += (angle if angle > 0.0 else -angle) * duration
        self.angle_squared += angle**2 * duration
        if window.fin_peak > self._peak:
            self._peak = window.fin_peak
        self._ticks += 1

    def close_half(self) -> None:
        self.halves += 1
        self.peaks += self._peak
        self.shortest = min(self.shortest, self._ticks)
        self.longest = max(self.longest, self._ticks)
        self._peak = 0.0
        self._ticks = 0

    def __iadd__(self, other: "_Sums") -> "_Sums":
        self.duration += other.duration
        self.impulse += other.impulse
        self.energy += other.energy
        self.peaks += other.peaks
        self.angle += other.angle
        self.angle_squared += other.angle_squared
        self.halves += other.halves
        self.shortest = min(self.shortest, other.shortest)
        self.longest = max(self.longest, other.longest)
        return self
