"""Identification of a fish from ticks: the choice of parameters, start values and fits.

Forces determine only products of K, λ, K_y and K_d: F_x is proportional to K λ², and F_y to K_y λ
and K_d λ. The assumption K_y = K separates K and λ. Its uncertainty is part of their intervals,
unless `lateral_inertia_ratio` is not in `fit`.
"""

import math
import os
from collections.abc import Sequence
from itertools import product
from operator import itemgetter
from typing import TYPE_CHECKING, TypeAlias

import msgspec
import numpy as np

from fishd.config import ServoSettings
from fishd.core import text
from fishd.core.dataframes import ticks_to_frame
from fishd.core.errors import ParameterError, RecordingError
from fishd.core.schema import suggest
from fishd.lab.identification.fit import (
    BOUNDS,
    FURTHER,
    LOGARITHMIC,
    QUADRATIC,
    Problem,
    solve,
)
from fishd.lab.identification.misfit import (
    MIN_TESTED_WINDOWS,
    all_white,
    find_missing_parameters,
    follows_commands,
)
from fishd.lab.identification.passages import MIN_PASSAGE_S, Passage, Unidentifiable, passages
from fishd.lab.identification.pulses import place_pulses
from fishd.lab.identification.result import Identification
from fishd.lab.identification.summary import MIN_CLEAR_FALL, SCALED, OtherLaw, summarise
from fishd.lab.identification.tail import add_fin_angles, collect_fin_angles
from fishd.lab.limits import find_excess
from fishd.lab.session import Session, refuse_lost
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.plant.servo_law import LAWS, ServoLaw

if TYPE_CHECKING:
    from pandas import DataFrame

    from fishd.recording import Run

    Source = DataFrame | Run | str | os.PathLike[str]

Fitted: TypeAlias = tuple[Problem, dict[str, float]]
"""A problem and the values that solve it."""
DEFAULT = (
    *("omega0", "xi", "quadratic_drag", "coupling", "servo_speed", "servo_lag"),
    *("thrust_coefficient", "lateral_inertia_ratio", "lateral_drag"),
    *("servo_delay", "backlash", "rotation"),
)
"""Parameters that are fitted by default; residuals may then require some of `FURTHER` too."""
POSSIBLE = tuple(BOUNDS)
"""Parameters that can be fitted."""
LAW = "servo_law"
"""Key of the law of the servo, which is chosen with Δ unless it is among the fixed parameters."""

_MIN_FALL = 4.0
"""Smallest fall of the sum of squares, in units of noise², for which a further parameter is fitted
although the residual is white: two standard errors."""
_MIN_SHARE = 0.05
"""Smallest share of the residual that a further parameter must explain to be fitted."""
_SETTLE_S = 2.0
"""Time at the start of a passage that is left out, as the motion before it is unknown [s]."""
_MAX_SETTLE_S = 20.0
"""Longest time at the start of a passage that is left out [s]."""
_SETTLE_TIME_CONSTANTS = 7.0
"""Time, in time constants of the fin, after which its initial state has no effect."""
_ROUGH_STEPS = 12
"""Largest number of steps of a rough fit, which compares start values."""
_MAX_UNLIKELINESS = 10.0
"""Largest logarithm of the ratio of likelihoods at which other pulses are considered, too."""
_MAX_PLACINGS = 5
"""Largest number of rough fits that find the pulses of the servo."""
_LAW_STEPS = 6
"""Largest number of steps of a fit with another law."""
_GOOD_SHARE = 0.98
"""Explained share of both forces above which no other start values are tried."""
_MIN_START_LAG, _ACCELERATING_SHARE = 0.03, 0.8
"""Smallest Δ [rad], and share of a delay, with which a fit of an accelerating wheel begins."""
_STARTS = tuple(product((1.0, 0.5, 2.0), (0.01, 0.06, 0.12)))
"""Start values: natural frequency, as a multiple of that of the given fish, and delay [s]."""
REST_S = 4.0
"""Length of the rest before the swim [s]: the tail stands still, so its state is known."""
MIN_EXPERIMENT_S = 30.0
"""Length of the shortest experiment; a shorter one determines too little [s]."""
MIN_CONTINUATION_S = REST_S + _SETTLE_S + 2.0 * MIN_PASSAGE_S
"""Length of the shortest end of an experiment that is worth swimming after an interruption [s]."""


def identify(
    runs: "Source | Sequence[Source]",
    *,
    start: PlantParameters | None = None,
    rig: SimulationSettings | None = None,
    fit: Sequence[str] | None = None,
    fix: Sequence[str] = (),
    servo: ServoSettings | None = None,
    tail_scale: float | None = None,
) -> Identification:
    """Fit a fish and its rig to recorded runs.

    runs: tables of ticks (`fishd.recording.read`, `experiment`), recordings, or their paths
    start: start values, and values of the parameters that are not fitted; by default the fish of
        Fu et al.
    rig: the same for `rotation`; by default the sensor is not rotated
    fit: parameters to fit: keys of section `plant` among `POSSIBLE`, and `rotation`; by default
        `DEFAULT` and those of `FURTHER` that the data require. With `servo_lag`, the law of the
        servo is chosen, too
    fix: parameters that are excluded from the fit. With `lateral_inertia_ratio`, K_y/K is as in
        `start`, and the intervals of K, λ and K_d are much narrower; likewise with `coupling`, if
        λ was measured
    servo: calibrated settings of the servo whose pulses carried the commands of tables; that of a
        recording of a robot is known
    tail_scale: half-width of the 95 % interval of the scale of measured fin angles, which are used,
        too, as a fraction; None leaves them out

    Raises `Unidentifiable` for runs without usable data, `ParameterError` for a name that cannot
    be fitted, and the errors of `fishd.recording.read`.
    """
    given_values = msgspec.structs.asdict(start or PlantParameters())
    given_values["rotation"] = (rig or SimulationSettings()).rotation
    further = tuple(name for name in FURTHER if fit is None and name not in fix)
    names = check((*DEFAULT, *filter(given_values.get, FURTHER)) if fit is None else fit, fix)
    opened = [_open(run) for run in _to_list(runs)]
    servos = [_servo(run, servo) for run in opened]
    tables = [_to_frame(run) for run in opened]
    fin = None if tail_scale is None else collect_fin_angles(opened, tables)
    parts = passages(tables, servos)
    _refuse_unusable(parts)
    values = {name: float(given_values[name]) for name in POSSIBLE}
    scale_is_free = _scale_is_free(names, values)
    if scale_is_free:
        names = tuple(name for name in names if name != "lateral_inertia_ratio")
    law: ServoLaw = (start or PlantParameters()).servo_law
    laws = LAWS if "servo_lag" in names and LAW not in fix else (law,)
    placings = [parts]
    if any(part.servo for part in parts):
        placings = _place_pulses(parts, names, _start_values(values, names, *_STARTS[0]), law)
    parts = placings[0]
    problem = Problem(parts, names, _SETTLE_S, law)
    (problem, values), others = _solve_from_starts(problem, values, further, laws)
    for placed in placings[1:]:
        other = Problem(placed, problem.names, _SETTLE_S, problem.law)
        other_values = solve(other, values)
        others.append((max(0.0, other.unexplained - problem.unexplained), other_values))
    settle = _settling_time(values)
    if settle > _SETTLE_S:
        longer = [part for part in parts if part.duration > settle + MIN_PASSAGE_S]
        parts, settle = (longer, settle) if longer else (parts, _SETTLE_S)
        problem = Problem(parts, problem.names, settle, problem.law)
        values = solve(problem, values)
    if fin is None or tail_scale is None:
        return summarise(parts, problem, values, given_values, scale_is_free, others)
    found = summarise(parts, problem, values, given_values, False, others)
    values = {**given_values, **values}
    return add_fin_angles(found, problem, values, fin, tail_scale, scale_is_free=scale_is_free)


def _place_pulses(
    parts: list[Passage], names: tuple[str, ...], values: dict[str, float], law: ServoLaw
) -> list[list[Passage]]:
    """Return the passages with the likeliest pulses, and with others that are nearly as likely.

    Rough fits find them, which begin with `values`.
    """
    fits: dict[bytes, tuple[float, list[Passage]]] = {}
    for _ in range(_MAX_PLACINGS):
        problem = Problem(parts, names, _SETTLE_S, law)
        values = solve(problem, values, rounds=1, steps=_ROUGH_STEPS)
        key = b"".join(part.angles.tobytes() + part.timing.begins.tobytes() for part in parts)
        fits[key] = problem.unexplained, parts
        placed = place_pulses(parts, problem, values, _SETTLE_S)
        if all(new is old for new, old in zip(placed, parts, strict=True)):
            break
        parts = placed  # two placings may lead to each other
    count = sum(forces.shape[1] for forces in problem.measured)
    ordered = sorted(fits.values(), key=itemgetter(0))
    return [
        parts for excess, parts in ordered if count * (excess - ordered[0][0]) < _MAX_UNLIKELINESS
    ]


def _refuse_unusable(parts: Sequence[Passage]) -> None:
    """Raise `Unidentifiable` for values that no fish has, and for a quantity that never changes."""
    for name, symbol, arrays, skip_s in (
        ("phi_c", "φ_c", [part.commands for part in parts], 0.0),
        ("fx", "F_x", [part.forces[0] for part in parts], _SETTLE_S),
        ("fy", "F_y", [part.forces[1] for part in parts], _SETTLE_S),
    ):
        if problem := find_excess(name, np.concatenate(arrays)):
            raise Unidentifiable(problem)
        skips = [int(np.searchsorted(part.ends[1:] * part.tick, skip_s)) for part in parts]
        if all(np.ptp(array[skip:]) == 0.0 for array, skip in zip(arrays, skips, strict=True)):
            raise Unidentifiable(
                f"{symbol} is the same in every row: a recording of a fish that swims is needed"
            )
    changes = [np.diff(part.forces, prepend=part.forces[:, :1]) for part in parts]
    if sum(len(part.times) for part in parts) >= MIN_TESTED_WINDOWS and not any(
        follows_commands(parts, [0] * len(parts), np.concatenate([c[force] for c in changes]))
        for force in range(2)
    ):
        raise Unidentifiable(
            "neither F_x nor F_y follows φ_c: a recording of a fish that swims is needed"
        )


def _scale_is_free(names: Sequence[str], values: dict[str, float]) -> bool:
    """Return whether K_y/K affects no force: all parameters that scale with it are free or zero."""
    needed = [name for name in SCALED if name in LOGARITHMIC or values[name]]
    return all(name in names for name in needed)


def _to_list(runs: object) -> list[object]:
    is_list = isinstance(runs, Sequence) and not isinstance(runs, str)
    return list(runs) if is_list else [runs]  # type: ignore[call-overload]


def _open(run: object) -> object:
    from fishd.recording import open_run

    return open_run(run) if isinstance(run, str | os.PathLike) else run


def _servo(run: object, given: ServoSettings | None) -> ServoSettings | None:
    """Return the calibrated settings of the servo of a recording, or those given for a table."""
    from fishd.recording import Run

    if not isinstance(run, Run):
        return given
    try:
        config = run.config
    except RecordingError:  # there is none, or it has a driver that is not installed here
        return None
    if not config.kind.has_hardware:
        return None
    return config.servo.calibrated(run.calibrations[0].servo) if run.calibrations else config.servo


def _to_frame(run: object) -> "DataFrame":
    from fishd.recording import Run

    if isinstance(run, Run):
        unit = run.summary.force_unit
        if unit != "N":
            raise Unidentifiable(
                f"{run.path}: its forces are in {text.quoted(unit)}, not in "
                "newtons: the force sensor was not calibrated; run 'fishctl calibrate force' and "
                "record the fish again"
            )
        return run.frame()
    return run  # type: ignore[return-value]


def check(fit: Sequence[str], fix: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the names of the parameters to fit, in order, without those in `fix`.

    Raises `ParameterError` for a name that cannot be fitted, and where no name is left.
    """
    for name in (*fit, *fix):
        if name not in POSSIBLE and not (name == LAW and name in fix):
            raise ParameterError(f"'{name}' cannot be fitted; {suggest(name, list(POSSIBLE))}")
    names = tuple(name for name in POSSIBLE if name in fit and name not in fix)
    if not names:
        raise ParameterError(f"nothing to fit; possible: {', '.join(POSSIBLE)}")
    return names


def _solve_from_starts(
    problem: Problem, first: dict[str, float], further: Sequence[str], laws: Sequence[ServoLaw]
) -> tuple[Fitted, list[OtherLaw]]:
    """Return the best fit from several start values, or the first if its residual is white.

    From the others, rough fits are made without quadratic drag; the best of them is completed.
    The result is as that of `_choose_law`.

    further: parameters that are fitted too where the residual resembles their effect
    laws: laws of the servo among which the best is chosen
    """
    starts = [_start_values(first, problem.names, *start) for start in _STARTS]
    choice = _choose_law((problem, solve(problem, starts[0])), further, laws)
    if all_white(*choice[0]) or _explained_share(*choice[0]) > _GOOD_SHARE:
        return choice
    rough_names = tuple(name for name in problem.names if name not in QUADRATIC) or problem.names
    rough = problem.changed(rough_names, choice[0][0].law)
    rough_fits = []
    for start in starts[1:]:
        values = solve(rough, start, rounds=1, steps=_ROUGH_STEPS)
        rough_fits.append((rough.unexplained, values))
    _, best = min(rough_fits, key=lambda fit: fit[0])
    candidate = problem.changed(problem.names, rough.law)
    later = _choose_law((candidate, solve(candidate, best)), further, laws)
    return min(choice, later, key=lambda choice: choice[0][0].unexplained)


def _explained_share(problem: Problem, values: dict[str, float]) -> float:
    """Return the smaller explained share of both forces, without drift."""
    left, whole = problem.residuals(values), problem.measured
    shares = (problem.whitened(left) ** 2).sum(axis=1) / (problem.whitened(whole) ** 2).sum(axis=1)
    return float(1.0 - shares.max())


def _choose_law(
    fitted: Fitted, further: Sequence[str], laws: Sequence[ServoLaw]
) -> tuple[Fitted, list[OtherLaw]]:
    """Return the fit with the most likely law of the servo, with those of `further` it requires.

    The second result are rough fits with the other laws, which begin with its values.
    """
    names, first = fitted[0].names, fitted[1]
    while True:
        fitted = problem, values = _add_required(*fitted, further)
        others = []
        for law in laws:
            if law != problem.law:
                other = problem.changed(problem.names, law)
                start = _as_start(values, problem.law, law)
                others.append((other, solve(other, start, rounds=1, steps=_LAW_STEPS)))
        best = min((fitted, *others), key=lambda fit: fit[0].unexplained)
        if best is fitted:
            return fitted, [(o.unexplained - problem.unexplained, values) for o, values in others]
        simple = problem.changed(names, best[0].law)
        fitted = simple, solve(simple, {**best[1], **{name: first[name] for name in further}})


def _as_start(values: dict[str, float], former: ServoLaw, law: ServoLaw) -> dict[str, float]:
    """Return start values for a law from a fit of another one.

    A wheel that has to gain its speed is late by Δ/Ω, which the others take for a delay.
    """
    delay, speed = values["servo_delay"], values["servo_speed"]
    if law == "accelerating":
        lag = max(_MIN_START_LAG, _ACCELERATING_SHARE * delay * speed)
        return {**values, "servo_lag": lag, "servo_delay": max(0.0, delay - lag / speed)}
    if former == "accelerating":
        return {**values, "servo_delay": delay + values["servo_lag"] / speed}
    return values


def _add_required(problem: Problem, values: dict[str, float], further: Sequence[str]) -> Fitted:
    """Return the fit with those of `further` that the data require, added one by one.

    A parameter is added at a small effect already, even if the residual is white: it biases the
    others before it is significant. One without an effect would only cost precision.
    """
    while True:
        white = all_white(problem, values)
        missing = find_missing_parameters(problem, values, further)
        if not missing or missing[0][1] < (_MIN_FALL if white else MIN_CLEAR_FALL):
            break
        name, _, size = missing[0]
        wider = problem.changed(check((*problem.names, name)), problem.law)
        wider_values = {**values, name: float(np.clip(size, *BOUNDS[name]))}
        wider_values = solve(wider, wider_values)
        if not white and wider.unexplained > problem.unexplained - 0.5 * _MIN_SHARE:
            break
        problem, values = wider, wider_values
    return problem, values


def _start_values(
    first: dict[str, float], names: tuple[str, ...], frequency: float, delay: float
) -> dict[str, float]:
    """Return start values of a fit; backlash is not zero, where its derivative vanishes."""
    values = dict(first)
    for name, value in (
        ("omega0", first["omega0"] * frequency),
        ("servo_delay", max(first["servo_delay"], delay)),
        ("backlash", max(first["backlash"], 0.01)),
    ):
        if name in names:
            values[name] = value
    return values


def _settling_time(values: dict[str, float]) -> float:
    """Return the time after which the initial state of the fin has no effect [s]."""
    omega0, xi = values["omega0"], values["xi"]
    slowest = 0.5 * omega0 * (xi - np.sqrt(max(0.0, xi * xi - 4.0)))
    return float(min(_SETTLE_TIME_CONSTANTS / slowest, _MAX_SETTLE_S))


def experiment(session: Session, seconds: float = 180.0) -> "DataFrame":
    """Rest, then swim `excitation` at the full amplitude of the rig; return one row per tick.

    seconds: length of the experiment, rest included [s]
    Raises `ParameterError` for less than `MIN_EXPERIMENT_S` or an infinite time, `Disturbed` where
    another client takes the fish, and the errors of the session.
    """
    if not MIN_EXPERIMENT_S <= seconds < math.inf:
        raise ParameterError(
            f"an experiment of {seconds:g} s: {MIN_EXPERIMENT_S:g} s or more are needed"
        )
    return _swim_excitation(session, seconds)


def continue_experiment(
    session: Session, recorded: "Sequence[DataFrame]", seconds: float
) -> "list[DataFrame]":
    """Swim the missing part of an experiment; return the tables of all its ticks.

    recorded: tables of the interrupted experiment; if empty, this is `experiment`
    seconds: length of the whole experiment [s]
    Raises the errors of `experiment`.
    """
    if not recorded:
        return [experiment(session, seconds)]
    missing = seconds - sum(map(len, recorded)) * session.tick
    tables = list(recorded)
    if missing >= MIN_CONTINUATION_S:
        tables.append(_swim_excitation(session, missing))
    return tables


def _swim_excitation(session: Session, seconds: float) -> "DataFrame":
    ticks = session.rest(REST_S)
    ticks += session.swim("excitation", {}, seconds - REST_S)
    refuse_lost(ticks, (REST_S, seconds - REST_S), session.tick)
    return ticks_to_frame(ticks)
