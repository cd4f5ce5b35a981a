"""Gait of a fish over whole beats: speed with its interval, width, powers and efficiency."""

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

MAX_GROUPS = 8
"""Largest number of groups of beats."""
MIN_BEATS_PER_GROUP = 2
"""Smallest number of beats in each group for the confidence interval."""
SIGNIFICANCE = 0.05
"""Significance level of the test for a trend of the speed."""
MIN_TREND = 0.01
"""Smallest relative difference between the two halves of the time that counts as a trend."""


class Gait(Struct, frozen=True, kw_only=True):
    """Means over whole beats; powers are per metre of depth."""

    beats: int
    """Number of whole beats in the means; with 0 they cover the whole time."""
    speed: float
    """Mean speed forwards, along −x [m/s]."""
    speed_ci95: float | None
    """Half-width of the 95 % confidence interval of `speed`, if the swim is steady [m/s]; None for
    fewer than four beats."""
    speed_trend: float | None
    """Relative change of the speed per second [1/s].

    None where it is not significant, or small; the swim then counts as steady.
    """
    frequency: float
    """Frequency of the beats; 0 without beats [Hz]."""
    heading: float
    """Mean angle of the front body to −x [rad]."""
    tail_width: float
    """Peak-to-peak lateral motion of the tip of the tail in the laboratory, over the length."""
    muscle_power: float
    """Mean power of the muscles [W/m]."""
    water_power: float
    """Mean power of the body on the water [W/m]."""
    steering_power: float
    """Mean power of the steering torque [W/m]."""
    cost_of_transport: float | None
    """Work of the muscles per mass and distance [J/(kg m)]; None without forward motion."""
    strouhal: float | None
    """Frequency times `tail_width` times length over speed; None without forward motion."""
    froude_efficiency: float | None
    """Thrust power over thrust power plus lateral power; None without forward motion."""
    reynolds: float
    """Speed times length over the viscosity of the water; 0 for inviscid water."""


def gait(track: dict[str, Array], settings: SwimmerSettings) -> Gait:
    """Return the gait of a track with the columns of `fishd.virtual.swimmer.track`, two rows or
    more.

    A beat begins with the first tick in which φ_c is positive again. The Froude efficiency follows
    Borazjani and Sotiropoulos (2008), "Numerical investigation of the hydrodynamics of carangiform
    swimming in the transitional and inertial flow regimes", J. Exp. Biol. 211,
    doi:10.1242/jeb.015644, but sums over the slices that push, whereas they use ½(F + |F|) of the
    total pressure force and of the total viscous force. Other definitions give other numbers. Here,
    thrust is the force of those slices of the body that are pushed forwards, thrust power is thrust
    times speed at each instant, and lateral power is that of the body on the water across the
    swimming direction.
    """
    time, x = track["time"], track["x"]
    begins = upward_reversals(track["phi_c"].tolist())
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
    _, means = _group_speeds(time, x, begins, MIN_BEATS_PER_GROUP)
    moves_forward = beats > 0 and speed > 0.0
    thrust_power, lateral_power = powers["thrust_power"], powers["lateral_power"]
    return Gait(
        beats=beats,
        speed=speed,
        speed_ci95=_speed_ci95(means),
        speed_trend=_speed_trend(*_group_speeds(time, x, begins, 1)),
        frequency=frequency,
        heading=float(track["heading"][rows].mean()),
        tail_width=width,
        muscle_power=powers["muscle_power"],
        water_power=powers["water_power"],
        steering_power=powers["steering_power"],
        cost_of_transport=powers["muscle_power"] / (mass(settings) * speed)
        if moves_forward
        else None,
        strouhal=frequency * width * length / speed if moves_forward else None,
        froude_efficiency=thrust_power / (thrust_power + lateral_power)
        if moves_forward and thrust_power + lateral_power > 0.0
        else None,
        reynolds=abs(speed) * length / viscosity if viscosity else 0.0,
    )


def mass(settings: SwimmerSettings) -> float:
    """Return the mass of the fish per metre of depth [kg/m]."""
    density = settings.water.density + settings.body.excess_density
    return density * build_beam(settings).area


def _tail_width(track: dict[str, Array], bounds: list[int]) -> float:
    """Return the range of y of the tail in a beat, averaged over the beats between `bounds` [m]."""
    swings = [
        track["tail_highest"][begin:end].max() - track["tail_lowest"][begin:end].min()
        for begin, end in pairwise(bounds)
    ]
    return float(np.mean(swings))


def _group_speeds(time: Array, x: Array, begins: list[int], min_beats: int) -> tuple[Array, Array]:
    """Return the middles [s] and mean speeds [m/s] of groups of at least `min_beats` adjacent
    beats.

    Successive beats are correlated, so adjacent ones are grouped: the means of a few long groups
    are nearly independent (Ibragimov and Müller, "t-statistic based correlation and heterogeneity
    robust inference", J. Bus. Econ. Stat. 28, 2010).
    """
    beats = len(begins) - 1
    groups = min(MAX_GROUPS, beats // min_beats)
    if groups < 2:
        return np.empty(0), np.empty(0)
    cuts = np.array(begins)[np.round(np.linspace(0, beats, groups + 1)).astype(int)] - 1
    return 0.5 * (time[cuts[1:]] + time[cuts[:-1]]), -np.diff(x[cuts]) / np.diff(time[cuts])


def _speed_ci95(means: Array) -> float | None:
    """Return the half-width of the 95 % confidence interval of the mean of equal groups [m/s]."""
    if not len(means):
        return None
    return float(stdtrit(len(means) - 1, 0.975) * means.std(ddof=1) / math.sqrt(len(means)))


def _speed_trend(moments: Array, means: Array) -> float | None:
    """Return the slope of the line through the means of the groups, relative to the speed [1/s].

    Kendall's test of the order of pairs decides on its significance, because a fish that starts
    from rest does not accelerate evenly (Mann, "Nonparametric tests against trend", Econometrica
    13, 1945). The trend is None where the two halves of the time differ by less than `MIN_TREND`.
    """
    groups = len(means)
    if groups < 2 or not means.mean() or kendalltau(moments, means).pvalue > SIGNIFICANCE:
        return None
    centred = moments - moments.mean()
    relative = float(centred @ means) / float(centred @ centred) / abs(float(means.mean()))
    half_duration = 0.5 * float(moments[-1] - moments[0]) * groups / (groups - 1)
    return relative if abs(relative) * half_duration > MIN_TREND else None
