"""How a fish swims over whole beats: speed with its interval, amplitude, powers and efficiency."""

import math
from itertools import pairwise

import numpy as np
from msgspec import Struct
from scipy.special import stdtrit

from fishd.swimmer.feasibility import build_beam
from fishd.swimmer.grid import Array
from fishd.swimmer.settings import SwimmerSettings

MOST_GROUPS = 8
LEAST_BEATS = 2
"""Beats are taken together in so many groups at most, each of so many beats or more."""


class Gait(Struct, frozen=True, kw_only=True):
    """Means over whole beats; forces and powers are those of a fish one metre deep."""

    beats: int
    """How many whole beats these figures are of; with 0 they are of all the time."""
    speed: float
    """Mean, forwards: along −x [m/s]."""
    speed_error: float | None
    """Half of its 95 % interval [m/s]; None for fewer than four beats."""
    frequency: float
    """Beats per second; 0 without any [Hz]."""
    heading: float
    """Mean, of the front body against −x [rad]."""
    tail_amplitude: float
    """How far the tip of the tail goes from side to side in the laboratory, over the length."""
    muscle_power: float
    """Of the muscles [W/m]."""
    water_power: float
    """Of the body on the water [W/m]."""
    cost_of_transport: float | None
    """Work of the muscles per mass and distance [J/(kg m)]; None where it does not get on."""
    strouhal: float | None
    """Frequency times `tail_amplitude` times length over speed; None where it does not get on."""
    froude_efficiency: float | None
    """Thrust power over thrust power and lateral power; None where it does not get on."""
    reynolds: float
    """Speed times length over the viscosity of the water; 0 for water without any."""


def gait(track: dict[str, Array], settings: SwimmerSettings) -> Gait:
    """Judge a track; columns as of `fishd.swimmer.track`, at least two rows.

    A beat begins with the first tick in which φ_c is positive again. The Froude efficiency is that
    of Borazjani and Sotiropoulos (2008), "Numerical investigation of the hydrodynamics of
    carangiform swimming in the transitional and inertial flow regimes", J. Exp. Biol. 211,
    doi:10.1242/jeb.015644: thrust is the force of those parts of the body that are pushed
    forwards, its power thrust times mean speed, and lateral power what the body does to the
    water across the swimming direction.
    """
    time, x = track["time"], track["x"]
    begins = upward_reversals(track["command"])
    beats = max(0, len(begins) - 1)
    first, last = (begins[0], begins[-1]) if beats else (1, len(time))
    rows = slice(first, last)
    duration = float(time[last - 1] - time[first - 1])
    speed = -float(x[last - 1] - x[first - 1]) / duration
    length, viscosity = settings.body.length, settings.water.viscosity
    frequency = beats / duration
    amplitude = _tail_amplitude(track, begins if beats else [first, last]) / length
    powers = {
        name: float(track[name][rows].mean())
        for name in ("muscle_power", "water_power", "thrust_power", "lateral_power")
    }
    gets_on = beats > 0 and speed > 0.0
    useful, lost = powers["thrust_power"], powers["lateral_power"]
    return Gait(
        beats=beats,
        speed=speed,
        speed_error=_error(time, x, begins),
        frequency=frequency,
        heading=float(track["heading"][rows].mean()),
        tail_amplitude=amplitude,
        muscle_power=powers["muscle_power"],
        water_power=powers["water_power"],
        cost_of_transport=powers["muscle_power"] / (mass(settings) * speed) if gets_on else None,
        strouhal=frequency * amplitude * length / speed if gets_on else None,
        froude_efficiency=useful / (useful + lost) if gets_on and useful + lost > 0.0 else None,
        reynolds=abs(speed) * length / viscosity if viscosity else 0.0,
    )


def mass(settings: SwimmerSettings) -> float:
    """Of a fish one metre deep [kg/m]."""
    density = settings.water.density + settings.body.excess_density
    return density * build_beam(settings).area


def upward_reversals(command: Array) -> list[int]:
    """The rows, but for the first, in which the command has become positive."""
    found, side = [], 0.0
    for index, angle in enumerate(command.tolist()):
        if index and side < 0.0 < angle:
            found.append(index)
        side = math.copysign(1.0, angle) if angle else side
    return found


def _tail_amplitude(track: dict[str, Array], bounds: list[int]) -> float:
    """Greatest less least y of the tail in each beat, mean over them [m]; bounds: of the beats."""
    swings = [
        track["tail_highest"][begin:end].max() - track["tail_lowest"][begin:end].min()
        for begin, end in pairwise(bounds)
    ]
    return float(np.mean(swings))


def _error(time: Array, x: Array, begins: list[int]) -> float | None:
    """Half of the 95 % interval of the mean speed [m/s].

    One beat is like the one before, so neighbours are taken together: the means of a few long
    groups are nearly independent (Ibragimov and Müller, "t-statistic based correlation and
    heterogeneity robust inference", J. Bus. Econ. Stat. 28, 2010).
    """
    beats = len(begins) - 1
    groups = min(MOST_GROUPS, beats // LEAST_BEATS)
    if groups < 2:
        return None
    cuts = np.array(begins)[np.round(np.linspace(0, beats, groups + 1)).astype(int)] - 1
    means = -np.diff(x[cuts]) / np.diff(time[cuts])
    return float(stdtrit(groups - 1, 0.975) * means.std(ddof=1) / math.sqrt(groups))
