"""How a fish swims over whole beats: speed with its interval, width, powers and efficiency."""

import math
from itertools import pairwise

import numpy as np
from msgspec import Struct
from scipy.special import stdtrit
from scipy.stats import kendalltau

from fishd.core.beats import upward_reversals
from fishd.virtual.swimmer.body import build_beam
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.settings import SwimmerSettings

MOST_GROUPS = 8
"""Beats are taken together in so many groups at most."""
LEAST_BEATS = 2
"""In each of the groups that give an interval."""
CHANCE = 0.05
"""How often a trend of the speed may be taken for one that is none."""
MATTERS = 0.01
"""A trend of the speed is told where the two halves of the time differ by more than this share."""


class Gait(Struct, frozen=True, kw_only=True):
    """Means over whole beats; powers are per metre of depth."""

    beats: int
    """How many whole beats these figures are of; with 0 they are of all the time."""
    speed: float
    """Mean, forwards: along −x [m/s]."""
    speed_error: float | None
    """Half of its 95 % interval, if the swim is steady [m/s]; None for fewer than four beats."""
    speed_trend: float | None
    """By which share of its speed it becomes faster in a second [1/s].

    None where that is no more than chance, or hardly matters; then the swim is taken as steady.
    """
    frequency: float
    """Beats per second; 0 without any [Hz]."""
    heading: float
    """Mean, of the front body against −x [rad]."""
    tail_width: float
    """How far the tip of the tail goes from side to side in the laboratory, over the length."""
    muscle_power: float
    """Of the muscles [W/m]."""
    water_power: float
    """Of the body on the water [W/m]."""
    steering_power: float
    """Of the torque that keeps the fish on its way [W/m]."""
    cost_of_transport: float | None
    """Work of the muscles per mass and distance [J/(kg m)]; None where it does not get on."""
    strouhal: float | None
    """Frequency times `tail_width` times length over speed; None where it does not get on."""
    froude_efficiency: float | None
    """Thrust power over thrust power and lateral power; None where it does not get on."""
    reynolds: float
    """Speed times length over the viscosity of the water; 0 for water without any."""


def gait(track: dict[str, Array], settings: SwimmerSettings) -> Gait:
    """Judge a track; columns as of `fishd.virtual.swimmer.track`, at least two rows.

    A beat begins with the first tick in which φ_c is positive again. The Froude efficiency is in
    the manner of Borazjani and Sotiropoulos (2008), "Numerical investigation of the hydrodynamics
    of carangiform swimming in the transitional and inertial flow regimes", J. Exp. Biol. 211,
    doi:10.1242/jeb.015644, but summed over the slices that push; they take ½(F + |F|) of the whole
    force of the pressure, and of the whole viscous one. Other definitions give other numbers.
    Thrust is here the force of those slices of the body that are pushed forwards, its power thrust
    times speed at each instant, and lateral power what the body does to the water across the
    swimming direction.
    """
    time, x = track["time"], track["x"]
    begins = upward_reversals(track["command"].tolist())
    beats = max(0, len(begins) - 1)
    first, last = (begins[0], begins[-1]) if beats else (1, len(time))
    rows = slice(first, last)
    duration = float(time[last - 1] - time[first - 1])
    speed = -float(x[last - 1] - x[first - 1]) / duration
    length, viscosity = settings.body.length, settings.water.viscosity
    frequency = beats / duration
    width = _tail_width(track, begins if beats else [first, last]) / length
    powers = {
        name: float(column[rows].mean())
        for name, column in track.items()
        if name.endswith("_power")
    }
    _, means = _grouped(time, x, begins, LEAST_BEATS)
    gets_on = beats > 0 and speed > 0.0
    useful, lost = powers["thrust_power"], powers["lateral_power"]
    return Gait(
        beats=beats,
        speed=speed,
        speed_error=_error(means),
        speed_trend=_trend(*_grouped(time, x, begins, 1)),
        frequency=frequency,
        heading=float(track["heading"][rows].mean()),
        tail_width=width,
        muscle_power=powers["muscle_power"],
        water_power=powers["water_power"],
        steering_power=powers["steering_power"],
        cost_of_transport=powers["muscle_power"] / (mass(settings) * speed) if gets_on else None,
        strouhal=frequency * width * length / speed if gets_on else None,
        froude_efficiency=useful / (useful + lost) if gets_on and useful + lost > 0.0 else None,
        reynolds=abs(speed) * length / viscosity if viscosity else 0.0,
    )


def mass(settings: SwimmerSettings) -> float:
    """Of the fish, per metre of depth [kg/m]."""
    density = settings.water.density + settings.body.excess_density
    return density * build_beam(settings).area


def _tail_width(track: dict[str, Array], bounds: list[int]) -> float:
    """Greatest less least y of the tail in each beat, mean over them [m]; bounds: of the beats."""
    swings = [
        track["tail_highest"][begin:end].max() - track["tail_lowest"][begin:end].min()
        for begin, end in pairwise(bounds)
    ]
    return float(np.mean(swings))


def _grouped(time: Array, x: Array, begins: list[int], least: int) -> tuple[Array, Array]:
    """Middles [s] and mean speeds [m/s] of groups of so many neighbouring beats at least.

    One beat is like the one before, so neighbours are taken together: the means of a few long
    groups are nearly independent (Ibragimov and Müller, "t-statistic based correlation and
    heterogeneity robust inference", J. Bus. Econ. Stat. 28, 2010).
    """
    beats = len(begins) - 1
    groups = min(MOST_GROUPS, beats // least)
    if groups < 2:
        return np.empty(0), np.empty(0)
    cuts = np.array(begins)[np.round(np.linspace(0, beats, groups + 1)).astype(int)] - 1
    return 0.5 * (time[cuts[1:]] + time[cuts[:-1]]), -np.diff(x[cuts]) / np.diff(time[cuts])


def _error(means: Array) -> float | None:
    """Half of the 95 % interval of the mean of groups that are alike [m/s]."""
    if not len(means):
        return None
    return float(stdtrit(len(means) - 1, 0.975) * means.std(ddof=1) / math.sqrt(len(means)))


def _trend(moments: Array, means: Array) -> float | None:
    """Growth of the speed, over the speed [1/s], from the line through the means of the groups.

    Beyond chance by Kendall's test, of how many pairs are in order, since a fish that starts from
    rest does not speed up evenly (Mann, "Nonparametric tests against trend", Econometrica 13,
    1945). It matters where it sets the two halves of the time `MATTERS` apart.
    """
    groups = len(means)
    if groups < 2 or not means.mean() or kendalltau(moments, means).pvalue > CHANCE:
        return None
    late = moments - moments.mean()
    relative = float(late @ means) / float(late @ late) / abs(float(means.mean()))
    half = 0.5 * float(moments[-1] - moments[0]) * groups / (groups - 1)
    return relative if abs(relative) * half > MATTERS else None
