"""A run in virtual time, judged by what the plant truly did."""

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from fishd.config import Config, check_tethered
from fishd.control.reporting import Publisher
from fishd.controllers import registry
from fishd.controllers.base import Controller, amplitude_of
from fishd.core.errors import ParameterError
from fishd.core.signals import Reason
from fishd.lab.simulation.beats import Beats
from fishd.lab.simulation.virtual_run import (
    VirtualRun,
    check_length,
)
from fishd.virtual.plant.optimum import best_square_wave


class Report(Struct, frozen=True):
    """The result of a run. Forces are the plant's true ones, over whole beats once settled."""

    controller: str
    parameters: dict[str, Any]
    amplitude: float
    """Φ: that of the controller, and of the best square wave it is compared with [rad]."""
    mean_thrust: float
    """[N]"""
    mean_power: float | None
    """Electrical power of the servo [W]; None for a plant without a motor."""
    frequency: float
    """Tail beats per second; 0 when the tail does not beat [Hz]."""
    half_beats: tuple[int, int]
    """The shortest and the longest half beat, in ticks; 0 when the tail does not beat."""
    reversals: int
    """Changes of the command's side in the time that is judged."""
    fin_amplitude: float
    """Largest fin angle of each half beat, mean over half beats [rad]."""
    fullness: float
    """Mean |φ_c|/Φ: 1 where the command uses all of the amplitude all of the time."""
    squareness: float
    """Mean |φ_c| over the rms of φ_c: square wave 1, sine 0.900, triangle 0.866; 0 without any."""
    relative_thrust: float
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
    quantities: dict[str, float]
    """Of the controller, at the end."""
    took_over: float | None
    """When it took over [s]; the figures are its own where that was before the end of settling."""
    microseconds_per_tick: float
    """What one turn of the loop took on this machine, once settled [µs]."""
    real_time_factor: float
    """Virtual seconds per second, once settled."""


def simulate(
    config: Config,
    name: str,
    parameters: Mapping[str, Any],
    seconds: float = 60.0,
    settle: float = 10.0,
    publisher: Publisher | None = None,
    begun: Callable[[VirtualRun], None] = lambda run: None,
) -> Report:
    """Let a controller swim a simulated fish for `seconds`, and judge it after `settle` seconds.

    publisher: gets the record of every tick, and every event; with None, no record is made
    begun: called before the first of them
    Raises `UnknownController` and `ParameterError`.
    """
    controller = registry.create(name, parameters, replace(config.limits, virtual=True))
    return judge(config, name, controller, seconds, settle, publisher, begun)


def count_ticks(seconds: float, settle: float, tick: float) -> tuple[int, int]:
    """How many ticks a run has, and the first that counts; raises `ParameterError`."""
    check_length("run", seconds)
    check_length("time to settle", settle)
    ticks = round(seconds / tick)
    first = math.ceil(settle / tick - 1e-9) + 1
    if first >= ticks:
        raise ParameterError(
            f"nothing is left to judge: a run of {seconds:g} s must be longer than the "
            f"{settle:g} s that it may take to settle"
        )
    return ticks, first


def check_whole_beat(report: Report, seconds: float, settle: float) -> None:
    """Raise `ParameterError` where the tail was reversed, but for less than a whole beat.

    The mean thrust over a part of a beat is that of no gait.
    """
    if report.reversals and not report.frequency:
        raise ParameterError(
            f"{report.controller}: no whole tail beat in the {seconds - settle:g} s after the "
            f"{settle:g} s of --settle, so there is no mean thrust; give more --seconds"
        )


def judge(
    config: Config,
    name: str,
    controller: Controller[Any],
    seconds: float,
    settle: float,
    publisher: Publisher | None,
    begun: Callable[[VirtualRun], None] = lambda run: None,
) -> Report:
    """As `simulate`, with a controller that is ready-made.

    publisher: gets the record of every tick; with None, no record is made
    begun: as for `simulate`
    Raises `ParameterError` where the lengths do not fit one another, and `ConfigError` where the
    fish swims freely.
    """
    check_tethered(config.robot, "relative_thrust")
    ticks, first = count_ticks(seconds, settle, config.tick)
    beats = Beats()
    since = 0.0
    took_over: float | None = None
    with VirtualRun(config, publisher) as virtual:
        begun(virtual)
        virtual.loop.set_controller(name, controller)
        for index in range(ticks):
            if index == first:  # the first ticks build what later ones reuse
                since = time.perf_counter()
            angle = virtual.loop.applied
            window = virtual.tick()
            if virtual.loop.active.fallback and took_over is None:
                took_over = index * config.tick
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
        squareness=means.squareness,
        relative_thrust=means.thrust / best.thrust if best.thrust > 0.0 else 0.0,
        best_square_thrust=best.thrust,
        best_square_frequency=best.frequency,
        ticks=ticks,
        mode=loop.supervisor.mode.value,
        reason=loop.supervisor.reason,
        fallback=fallback,
        successor=successor,
        quantities=quantities,
        took_over=took_over,
        microseconds_per_tick=elapsed / (ticks - first) * 1e6,
        real_time_factor=(ticks - first) * config.tick / elapsed,
    )
