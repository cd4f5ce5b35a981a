"""Policies and controllers on a fish that can only be measured: its thrust, and the interval."""

import math
from collections.abc import Callable, Iterable

import numpy as np
from msgspec.structs import replace

from fishd.core.calibration import ForceCalibration
from fishd.core.errors import FishdError
from fishd.core.signals import Tick
from fishd.lab.compare.comparison import Standing, Trace, error_of_mean, trace
from fishd.lab.compare.contestants import Contestant, parse
from fishd.lab.error_budget import budget
from fishd.lab.measurement import Measured, measure, plan
from fishd.lab.objective import per_watt
from fishd.lab.rig import Rig, is_of_one


class LiveComparison:
    """Measures contestants on one fish, one after the other; keeps what was measured."""

    def __init__(self, rig: Rig, contestants: Iterable[Contestant | str]) -> None:
        """contestants: texts are parsed: see `parse`, which raises `ParameterError`"""
        self.contestants = [parse(one) if isinstance(one, str) else one for one in contestants]
        self.left_out: list[tuple[Contestant, FishdError, int]] = []
        """Who could not be measured, or no further, why, and after how many runs."""
        self._rig = rig
        self._measured: list[list[Measured]] = [[] for _ in self.contestants]

    def swim(
        self,
        seconds: float = 60.0,
        runs: int = 1,
        progress: Callable[[float], None] = lambda seconds: None,
    ) -> None:
        """Let each swim and rest in turn, for so long in each run.

        With several runs everyone swims once, then everyone again, so that what changes slowly
        meets all of them. Who cannot swim is left out, and the others go on; what it swam before
        counts.

        progress: called with the time that has passed, or need not pass any more [s]
        Raises `ParameterError` for a time that is too short, `Disturbed` and `NoDaemon`.
        """
        for contestant in self.contestants:
            plan(seconds, contestant.parameters)
        out = set[int]()
        turns = [index for _ in range(runs) for index in range(len(self.contestants))]
        for turn, index in enumerate(turns):
            begun = turn * seconds
            if index in out:
                continue
            contestant = self.contestants[index]
            try:
                found = measure(
                    self._rig,
                    contestant.controller,
                    contestant.parameters,
                    seconds,
                    lambda passed, begun=begun: progress(begun + passed),  # type: ignore[misc]
                )
            except FishdError as error:
                if not is_of_one(error):
                    raise
                self.left_out.append((contestant, error, len(self._measured[index])))
                out.add(index)
                continue
            self._measured[index].append(found)

    def standings(self) -> list[Standing]:
        """Of all that were measured, in the order given."""
        pairs = zip(self.contestants, self._measured, strict=True)
        return [_standing(one.label, found, self._rig) for one, found in pairs if found]

    def traces(self) -> list[Trace]:
        """The ends of their last swims, without the drift."""
        return [_trace(found[-1]) for found in self._measured if found]


def _standing(label: str, runs: list[Measured], rig: Rig) -> Standing:
    """Runs count by the inverse squares of their errors.

    Where they differ by more than these say, the error is that of their mean by Student's t.
    """
    weights = [1.0 / run.error**2 for run in runs]
    total = sum(weights)
    thrusts = [run.thrust for run in runs]
    angles = [abs(tick.phi_c) for run in runs for tick in run.ticks if tick.mode == "running"]
    mean = sum(angles) / len(angles)
    rms = math.sqrt(sum(angle**2 for angle in angles) / len(angles))
    standing = Standing(
        contestant=label,
        controller=runs[0].controller,
        parameters=dict(runs[0].parameters),
        thrust=sum(w * run.thrust for w, run in zip(weights, runs, strict=True)) / total,
        error=max(1.0 / math.sqrt(total), error_of_mean(thrusts) or 0.0),
        thrusts=thrusts,
        frequency=sum(w * run.frequency for w, run in zip(weights, runs, strict=True)) / total,
        fullness=mean / rig.amplitude,
        squareness=mean / rms if rms else 0.0,
    )
    standing = replace(standing, **_power(runs))
    return replace(standing, **_budget(runs, weights, standing, rig.calibration))


def _power(runs: list[Measured]) -> dict[str, float]:
    """Power and thrust for each watt, as the thrust; nothing where not every run knows it."""
    found = [
        (run.watts, *per_watt(run.thrust, run.error, run.watts, run.watts_error)) for run in runs
    ]
    known = [(watts, gave, error) for watts, gave, error in found if watts and gave and error]
    if len(known) < len(runs):
        return {}
    weights = [1.0 / error**2 for _, _, error in known]
    total = sum(weights)
    gave = [each for _, each, _ in known]
    return {
        "power": sum(watts for watts, _, _ in known) / len(known),
        "thrust_per_watt": sum(w * each for w, each in zip(weights, gave, strict=True)) / total,
        "thrust_per_watt_error": max(1.0 / math.sqrt(total), error_of_mean(gave) or 0.0),
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
