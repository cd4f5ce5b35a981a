"""From ticks to a fish: starts and fits, and what of the fish they are for.

K, λ, K_y and K_d cannot be told apart by forces: F_x is K λ² times what the wheel does, F_y is
K_y λ and K_d λ times it. K and λ are told apart by K_y = K. How far that may be wrong is part of
their intervals, unless `lateral_inertia_ratio` is left out of `fit`.
"""

import os
from collections.abc import Sequence
from itertools import product
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from fishd.core import text
from fishd.core.errors import ParameterError
from fishd.core.schema import nearest
from fishd.lab.identification import misfit
from fishd.lab.identification.fit import (
    BOUNDS,
    FURTHER,
    LOGARITHMIC,
    QUADRATIC,
    Problem,
    solve,
)
from fishd.lab.identification.passages import SHORTEST, Passage, Unidentifiable, passages
from fishd.lab.identification.result import (
    Identification,
)
from fishd.lab.identification.summary import CLEAR, SCALED, summarise
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters

if TYPE_CHECKING:
    from pandas import DataFrame

DEFAULT = (
    *("omega0", "xi", "quadratic_drag", "coupling", "servo_speed", "servo_lag"),
    *("thrust_coefficient", "lateral_inertia_ratio", "lateral_drag"),
    *("servo_delay", "backlash", "rotation"),
)
"""What is fitted by default; what is left over may then demand some of `FURTHER`, too."""
POSSIBLE = tuple(BOUNDS)

_LIKELY = 4.0
"""Smallest fall of the sum of squares, in units of noise², with which something further is fitted
though what is left over is white: two standard errors."""
_DEMANDED = 0.05
"""Smallest share of what is left over that something further must explain to be fitted."""
_SETTLE = 2.0
"""How long the beginning of a passage is not judged, since nobody knows what was before [s]."""
_LONGEST_SETTLE = 20.0
_FORGOTTEN = 7.0
"""Time constants of the fin after which its start is forgotten."""
_ROUGH = 12
"""Steps of a fit that shows whether it is worth going on."""
_STARTS = tuple(product((1.0, 0.5, 2.0), (0.01, 0.06, 0.12)))
"""Natural frequency, as a multiple of that of the first fish, and delay [s]."""


def identify(
    runs: "DataFrame | str | os.PathLike[str] | Sequence[DataFrame | str | os.PathLike[str]]",
    *,
    start: PlantParameters | None = None,
    rig: SimulationSettings | None = None,
    fit: Sequence[str] | None = None,
    fix: Sequence[str] = (),
) -> Identification:
    """Fit a fish and its rig to what some runs of it have measured.

    runs: tables of ticks (`fishd.recording.read`, `experiment`), or paths of recordings
    start: where to begin, and the value of what is not fitted; by default the fish of Fu et al.
    rig: the same for `rotation`; by default the sensor is not turned
    fit: what to fit: keys of section `plant` among `POSSIBLE`, and `rotation`; by default `DEFAULT`
        and what of `FURTHER` the data demand
    fix: what of that is not fitted. With `lateral_inertia_ratio`, K_y/K is as in `start`, and K, λ
        and K_d are known so much better; so they are with `coupling`, if λ was measured

    Raises `Unidentifiable` for runs that hold nothing to fit, `ParameterError` for a name in `fit`
    that is not possible, and what `fishd.recording.read` raises.
    """
    known = msgspec.structs.asdict(start or PlantParameters())
    known["rotation"] = (rig or SimulationSettings()).rotation
    further = tuple(name for name in FURTHER if fit is None and name not in fix)
    names = check((*DEFAULT, *filter(known.get, FURTHER)) if fit is None else fit, fix)
    parts = passages([_table(run) for run in _several(runs)])
    if not any(one.commands.any() for one in parts):
        raise Unidentifiable("φ_c is zero all the time: a recording of a fish that swims is needed")
    values = {name: float(known[name]) for name in POSSIBLE}
    scale_is_free = _scale_is_free(names, values)
    if scale_is_free:
        names = tuple(name for name in names if name != "lateral_inertia_ratio")
    problem, values = _solved(parts, names, values, further)
    settle = _settling(values)
    if settle > _SETTLE:
        longer = [one for one in parts if one.duration > settle + SHORTEST]
        parts, settle = (longer, settle) if longer else (parts, _SETTLE)
        problem = Problem(parts, problem.names, settle)
        values = solve(problem, values)
    return summarise(parts, problem, values, known, scale_is_free)


def _scale_is_free(names: Sequence[str], values: dict[str, float]) -> bool:
    """Return whether K_y/K changes no force: all that goes with it is fitted, or zero."""
    needed = [name for name in SCALED if name in LOGARITHMIC or values[name]]
    return all(name in names for name in needed)


def _several(runs: object) -> list[object]:
    is_list = isinstance(runs, Sequence) and not isinstance(runs, str)
    return list(runs) if is_list else [runs]  # type: ignore[call-overload]


def _table(run: object) -> "DataFrame":
    if isinstance(run, str | os.PathLike):
        from fishd.recording import open_run

        recorded = open_run(run)
        unit = recorded.summary.force_unit
        if unit != "N":
            raise Unidentifiable(
                f"{recorded.path}: its forces are in {text.quoted(unit)}, not in "
                "newtons: the force sensor was not calibrated; calibrate it by 'fishctl calibrate "
                "force', and record it again"
            )
        return recorded.frame()
    return run  # type: ignore[return-value]


def check(fit: Sequence[str], fix: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of what to fit, in order, without those of `fix`.

    Raises `ParameterError` for one that is not possible, and where nothing is left.
    """
    for name in (*fit, *fix):
        if name not in POSSIBLE:
            raise ParameterError(f"'{name}' cannot be fitted; {nearest(name, list(POSSIBLE))}")
    names = tuple(name for name in POSSIBLE if name in fit and name not in fix)
    if not names:
        raise ParameterError(f"nothing to fit; possible: {', '.join(POSSIBLE)}")
    return names


def _solved(
    parts: Sequence[Passage],
    names: tuple[str, ...],
    first: dict[str, float],
    further: Sequence[str],
) -> tuple[Problem, dict[str, float]]:
    """Return the best fit of several starts; of one, where it leaves no more than noise.

    The others are fitted roughly, without quadratic drag, and the best of them to its end.

    further: what is fitted, too, where what is left over looks like it
    """
    starts = [_begun(first, names, *start) for start in _STARTS]
    problem = Problem(parts, names, _SETTLE)
    values = solve(problem, starts[0])
    problem, values = _extended(parts, problem, values, further)
    if misfit.all_white(problem, values):
        return problem, values
    rough = []
    few = tuple(name for name in names if name not in QUADRATIC) or names
    for start in starts[1:]:
        other = Problem(parts, few, _SETTLE)
        rough.append((solve(other, start, rounds=1, steps=_ROUGH), other))
    best, _ = min(rough, key=lambda each: each[1].unexplained)
    other = Problem(parts, names, _SETTLE)
    best = solve(other, best)
    other, best = _extended(parts, other, best, further)
    return (other, best) if other.unexplained < problem.unexplained else (problem, values)


def _extended(
    parts: Sequence[Passage],
    problem: Problem,
    values: dict[str, float],
    further: Sequence[str],
) -> tuple[Problem, dict[str, float]]:
    """Return the fit with what of `further` the data demand, one after the other.

    They are fitted at the first sign of them, even if what is left over is white: a little of them
    makes others wrong before it is seen. Where there is none, they would cost precision.
    """
    while True:
        white = misfit.all_white(problem, values)
        looks_like = misfit.likenesses(problem, values, further)
        if not looks_like or looks_like[0][1] < (_LIKELY if white else CLEAR):
            break
        name, _, size = looks_like[0]
        wider = Problem(parts, check((*problem.names, name)), _SETTLE)
        begun = {**values, name: float(np.clip(size, *BOUNDS[name]))}
        begun = solve(wider, begun)
        if not white and wider.unexplained > problem.unexplained - 0.5 * _DEMANDED:
            break
        problem, values = wider, begun
    return problem, values


def _begun(
    first: dict[str, float], names: tuple[str, ...], frequency: float, delay: float
) -> dict[str, float]:
    """Where a fit begins; away from zero, where backlash has no slope."""
    begun = dict(first)
    for name, value in (
        ("omega0", first["omega0"] * frequency),
        ("servo_delay", max(first["servo_delay"], delay)),
        ("backlash", max(first["backlash"], 0.01)),
    ):
        if name in names:
            begun[name] = value
    return begun


def _settling(values: dict[str, float]) -> float:
    """How long the fin remembers where it was [s]."""
    omega0, xi = values["omega0"], values["xi"]
    slowest = 0.5 * omega0 * (xi - np.sqrt(max(0.0, xi * xi - 4.0)))
    return float(min(_FORGOTTEN / slowest, _LONGEST_SETTLE))
