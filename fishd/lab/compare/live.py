"""Policies and controllers on a fish that can only be measured: its thrust, and the interval."""

import math
from collections.abc import Iterable

import numpy as np
from msgspec.structs import replace

from fishd.core.calibration import ForceCalibration
from fishd.core.errors import FishdError
from fishd.core.signals import Tick
from fishd.lab.compare.comparison import Standing, Trace, trace
from fishd.lab.compare.contestants import Contestant, parse
from fishd.lab.error_budget import budget
from fishd.lab.measurement import Measured, measure, plan
from fishd.lab.session import Session, concerns_one_controller
from fishd.lab.statistics import per_watt, weighted_mean


class LiveComparison:
    """Measures contestants on one fish, one after the other; keeps what was measured."""

    def __init__(self, session: Session, contestants: Iterable[Contestant | str]) -> None:
        """contestants: texts are parsed: see `parse`, which raises `ParameterError`"""
        self.contestants = [parse(one) if isinstance(one, str) else one for one in contestants]
        self.left_out: list[tuple[Contestant, FishdError, int]] = []
        """Who could not be measured, or no further, why, and after how many runs."""
        self._session = session
        self._measured: list[list[Measured]] = [[] for _ in self.contestants]

    def swim(self, seconds: float = 60.0, runs: int = 1) -> None:
        """Swim and rest each contestant in turn, for `seconds` in each run.

        With several runs all contestants swim once, then all again, so that what changes slowly
        affects all of them. One that cannot swim is left out, and the others go on; what it swam
        before counts.

        Raises `ParameterError` for a time that is too short, `Disturbed` and `NoDaemon`.
        """
        for contestant in self.contestants:
            plan(seconds, contestant.parameters)
        out = set[int]()
        turns = [index for _ in range(runs) for index in range(len(self.contestants))]
        for index in turns:
            if index in out:
                continue
            contestant = self.contestants[index]
            try:
                found = measure(
                    self._session, contestant.controller, contestant.parameters, seconds
                )
            except FishdError as error:
                if not concerns_one_controller(error):
                    raise
                self.left_out.append((contestant, error, len(self._measured[index])))
                out.add(index)
                continue
            self._measured[index].append(found)

    def standings(self) -> list[Standing]:
        """Of all that were measured, in the order given."""
        pairs = zip(self.contestants, self._measured, strict=True)
        return [_standing(one.label, found, self._session) for one, found in pairs if found]

    def traces(self) -> list[Trace]:
        """The ends of their last swims, without the drift."""
        return [_trace(found[-1]) for found in self._measured if found]


def _standing(label: str, runs: list[Measured], session: Session) -> Standing:
    """Runs count by the inverse squares of their errors.

    Where they differ by more than these say, the error is that of their mean by Student's t.
    """
    thrusts = [run.thrust for run in runs]
    weights = [1.0 / run.error**2 for run in runs]
    thrust, error = weighted_mean(thrusts, [run.error for run in runs])
    angles = [abs(tick.phi_c) for run in runs for tick in run.ticks if tick.mode == "running"]
    mean = sum(angles) / len(angles)
    rms = math.sqrt(sum(angle**2 for angle in angles) / len(angles))
    standing = Standing(
        contestant=label,
        controller=runs[0].controller,
        parameters=dict(runs[0].parameters),
        thrust=thrust,
        error=error,
        thrusts=thrusts,
        frequency=float(np.average([run.frequency for run in runs], weights=weights)),
        fullness=mean / session.amplitude,
        squareness=mean / rms if rms else 0.0,
    )
    standing = replace(standing, **_power(runs))
    return replace(standing, **_budget(runs, weights, standing, session.calibration))


def _power(runs: list[Measured]) -> dict[str, float]:
    """Power and thrust for each watt, as the thrust; nothing where not every run knows it."""
    found = [
        (run.watts, *per_watt(run.thrust, run.error, run.watts, run.watts_error)) for run in runs
    ]
    known = [(watts, gave, error) for watts, gave, error in found if watts and gave and error]
    if len(known) < len(runs):
        return {}
    mean, ci95 = weighted_mean([each for _, each, _ in known], [error for _, _, error in known])
    return {
        "power": sum(watts for watts, _, _ in known) / len(known),
        "thrust_per_watt": mean,
        "thrust_per_watt_error": ci95,
    }


def _budget(
    runs: list[Measured], weights: list[float], standing: Standing, calibration: ForceCalibration
) -> dict[str, float | None]:
    """The part of the calibration: the same error in all runs, so that more of them do not help.

    weights: by which the runs count
    """
    rotation, lateral = np.average(
        [(run.rotation, run.lateral) for run in runs], axis=0, weights=weights
    ).tolist()
    whole = budget(calibration, standing.thrust, standing.error, lateral, rotation)
    found = whole._asdict()
    if standing.power and standing.thrust_per_watt is not None:
        found["thrust_per_watt_total_ci95"] = budget(
            calibration,
            standing.thrust_per_watt,
            standing.thrust_per_watt_error,
            lateral / standing.power,
            rotation,
        ).total_ci95
    return found


def _trace(run: Measured) -> Trace:
    swim = _last_swim(run)
    begun = run.ticks[0].t
    drift = np.interp([tick.t - begun for tick in swim], run.blocks.time, run.drift)
    corrected = [replace(t, fx=t.fx - float(d)) for t, d in zip(swim, drift, strict=True)]
    return trace(corrected)


def _last_swim(run: Measured) -> list[Tick]:
    swim: list[Tick] = []
    for each in reversed(run.ticks):
        if each.mode == "running":
            swim.append(each)
        elif swim:
            break
    return swim[::-1]
