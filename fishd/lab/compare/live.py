"""Comparison of policies and controllers on a real fish, by measured thrust with intervals."""

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from msgspec.structs import replace

from fishd.core.errors import FishdError
from fishd.core.signals import Tick
from fishd.core.swim_plan import plan
from fishd.lab.compare.comparison import Standing, Trace, trace
from fishd.lab.compare.contestants import Contestant, parse
from fishd.lab.error_budget import thrust_fields
from fishd.lab.measurement import ThrustMeasurement, measure
from fishd.lab.session import Session, concerns_one_controller
from fishd.lab.statistics import weighted_mean


class LiveComparison:
    """A comparison of contestants on one fish, which stores all measurements."""

    def __init__(self, session: Session, contestants: Iterable[Contestant | str]) -> None:
        """contestants: contestants, or texts for `parse`, which raises `ParameterError`"""
        self.contestants = [parse(item) if isinstance(item, str) else item for item in contestants]
        self.left_out: list[tuple[Contestant, FishdError, int]] = []
        """Contestants that failed, each with the error and the number of runs before it."""
        self._session = session
        self._measured: list[list[ThrustMeasurement]] = [[] for _ in self.contestants]

    def swim(
        self, seconds: float = 60.0, runs: int = 1, done: Callable[[], None] = lambda: None
    ) -> None:
        """Swim and rest each contestant in turn, for `seconds` in each run.

        With several runs, all contestants swim once, then all again, so that slow changes affect
        all of them equally. A contestant that fails is left out of later runs; its earlier runs
        count.

        done: called after each run
        Raises `ParameterError` for a time that is too short, `Disturbed` and `NoDaemon`.
        """
        self.check(seconds)
        excluded = set[int]()
        order = [index for _ in range(runs) for index in range(len(self.contestants))]
        for index in order:
            if index in excluded:
                continue
            contestant = self.contestants[index]
            try:
                measurement = measure(
                    self._session, contestant.controller, contestant.parameters, seconds
                )
            except FishdError as error:
                if not concerns_one_controller(error):
                    raise
                self.left_out.append((contestant, error, len(self._measured[index])))
                excluded.add(index)
                continue
            self._measured[index].append(measurement)
            done()

    def check(self, seconds: float) -> None:
        """Raise `ParameterError` if a run of this length is not possible."""
        for contestant in self.contestants:
            plan(seconds, contestant.parameters)

    def standings(self) -> list[Standing]:
        """Return the standings of all measured contestants, in the given order."""
        pairs = zip(self.contestants, self._measured, strict=True)
        return [
            _standing(contestant.label, runs, self._session) for contestant, runs in pairs if runs
        ]

    def remarks(self) -> list[tuple[str, str]]:
        """Return the remarks on measurements, each after the label of its contestant."""
        pairs = zip(self.contestants, self._measured, strict=True)
        return [(c.label, run.remark) for c, runs in pairs for run in runs if run.remark]

    def traces(self) -> list[Trace]:
        """Return the ends of their last swims, with the drift subtracted."""
        return [_trace(runs[-1]) for runs in self._measured if runs]


def _standing(label: str, runs: list[ThrustMeasurement], session: Session) -> Standing:
    """Return the standing of a contestant, with runs weighted by inverse squared errors.

    Where runs scatter by more than their errors, the error of the mean uses Student's t.
    """
    thrusts = [run.thrust for run in runs]
    weights = [1.0 / run.thrust_ci95**2 for run in runs]
    thrust, error = weighted_mean(thrusts, [run.thrust_ci95 for run in runs])
    angles = [abs(tick.phi_c) for run in runs for tick in run.ticks if tick.mode == "running"]
    mean = sum(angles) / len(angles)
    rms = math.sqrt(sum(angle**2 for angle in angles) / len(angles))
    rotation, lateral = np.average(
        [(run.rotation, run.lateral) for run in runs], axis=0, weights=weights
    ).tolist()
    return Standing(
        contestant=label,
        controller=runs[0].controller,
        parameters=dict(runs[0].parameters),
        thrusts=thrusts,
        frequency=float(np.average([run.frequency for run in runs], weights=weights)),
        fullness=mean / session.amplitude,
        form_factor=mean / rms if rms else 0.0,
        **thrust_fields(
            session.calibration, thrust, error, rotation=rotation, lateral=lateral, **_power(runs)
        ),
        **_fin_angle(runs),
    )


def _power(runs: list[ThrustMeasurement]) -> dict[str, Any]:
    """Return power and thrust per watt, for `thrust_fields`; empty if unknown for any run."""
    complete = [
        (run.power, run.thrust_per_watt, run.thrust_per_watt_ci95)
        for run in runs
        if run.power and run.thrust_per_watt and run.thrust_per_watt_ci95
    ]
    if len(complete) < len(runs):
        return {}
    power, per_watt, errors = zip(*complete, strict=True)
    return {"power": sum(power) / len(power), "thrust_per_watt": weighted_mean(per_watt, errors)}


def _fin_angle(runs: list[ThrustMeasurement]) -> dict[str, Any]:
    """Return the fields about the fin angle; none if it is unknown for any run."""
    pairs = [(run.fin_angle_max, run.fin_angle_max_ci95) for run in runs]
    known = [(value, ci95) for value, ci95 in pairs if value is not None and ci95]
    if len(known) < len(runs):
        return {}
    value, ci95 = weighted_mean(*zip(*known, strict=True))
    return {"fin_angle_max": value, "fin_angle_max_ci95": ci95}


def _trace(run: ThrustMeasurement) -> Trace:
    swim = _last_swim(run)
    start = run.ticks[0].time
    drift = np.interp([tick.time - start for tick in swim], run.blocks.time, run.drift)
    corrected = [replace(t, fx=t.fx - float(d)) for t, d in zip(swim, drift, strict=True)]
    return trace(corrected)


def _last_swim(run: ThrustMeasurement) -> list[Tick]:
    swim: list[Tick] = []
    for tick in reversed(run.ticks):
        if tick.mode == "running":
            swim.append(tick)
        elif swim:
            break
    return swim[::-1]
