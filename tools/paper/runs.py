"""Runs of the loop on a simulated fish, in parallel, and tables of their results."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import joblib
from msgspec.structs import replace

from common.report import DOCS
from fishd.camera.simulated import SimulatedCameraSettings
from fishd.config import Config
from fishd.core.estimation import EstimatorSettings
from fishd.lab.compare.contestants import Contestant, SeeingController, build
from fishd.lab.simulation import KeepingPublisher, Report, VirtualRun, judge
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters

FOLDER = DOCS / "figures"
PLANT = PlantParameters()
FINE_TICK = 0.005
"""Tick of runs that represent continuous time [s]."""
PERFECT = SimulationSettings(noise=0.0)
TRUE_VELOCITY = EstimatorSettings(
    leak=PLANT.thrust_coefficient / PLANT.lateral_drag, bias_time=1000.0
)
"""Estimator that returns the true fin velocity for a sensor without noise and offset."""
Row = Mapping[str, float | str]


class Run(NamedTuple):
    """Controller, fish and length of a run."""

    controller: str
    parameters: dict[str, Any]
    config: Config
    seconds: float
    settle: float


def swim(run: Run) -> Report:
    """Perform one run; raises SystemExit after a fault or a takeover by another controller.

    A policy from pictures sees the fish through the default simulated camera.
    """
    limits = replace(run.config.limits, virtual=True)
    contestant = Contestant(run.controller, run.controller, run.parameters)
    controller = build(contestant, limits, SimulatedCameraSettings())
    watch = controller.watch if isinstance(controller, SeeingController) else _nothing
    report = judge(
        *(run.config, run.controller, controller, run.seconds, run.settle),
        KeepingPublisher(),
        watch,
    )
    if trouble := report.reason or report.fallback:
        raise SystemExit(f"{run.controller} {run.parameters}: {trouble.message}")
    return report


def _nothing(_: VirtualRun) -> None:
    """Return None, for policies without a camera."""


def swim_all(runs: Iterable[Run], jobs: int) -> list[Report]:
    """Perform all runs on `jobs` cores, and return the results in their order."""
    chosen: list[Report] = joblib.Parallel(jobs)(joblib.delayed(swim)(run) for run in runs)
    return chosen


def write(name: str, rows: Sequence[Row]) -> None:
    """Write docs/figures/NAME.csv; the columns are the keys of the first row.

    Numbers have four or five digits, so that the file is the same on every machine.
    """
    with (FOLDER / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows({key: _format_number(value) for key, value in row.items()} for row in rows)


def read(name: str, **having: str | float) -> list[dict[str, Any]]:
    """Return the rows of docs/figures/NAME.csv with given values in columns, as numbers."""
    with (FOLDER / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        rows = [{k: _number(v) for k, v in row.items()} for row in csv.DictReader(file)]
    return [row for row in rows if all(row[key] == value for key, value in having.items())]


def column(rows: Iterable[Mapping[str, Any]], name: str) -> list[Any]:
    """Return one column of some rows."""
    return [row[name] for row in rows]


def _format_number(value: float | str) -> str:
    if isinstance(value, str):
        return value
    if value == 0.0 or abs(value) < 1e-9:
        return "0"
    digits = max(0, 4 - math.floor(math.log10(abs(value))))
    return f"{value:.{digits}f}".rstrip("0").rstrip(".") if digits else f"{value:.0f}"


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text
