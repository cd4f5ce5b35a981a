"""The error of a free swimmer's speed that its grid causes, from the same swim on several grids.

The error is Richardson's, as the grid convergence index: the extrapolated error times a factor of
safety (Roache, "Perspective: a method for uniform reporting of grid refinement studies", J. Fluids
Eng. 116, 1994, doi:10.1115/1.2910291).
"""

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import replace

from fishd.config import Config
from fishd.core import files
from fishd.core.errors import FishdError

ASSUMED_ORDER = 1.0
"""Order for two grids, and for three that do not show one: that of the surface of the body."""
ORDERS = 0.5, 3.0
"""Range of observed orders in which the speed counts as converging.

At the lower one, with cells of half the size, both factors of safety give the same error.
"""
MAX_ORDER = 2.0
"""Largest order with which errors are computed, that of the scheme."""
SAFETY, CAUTIOUS_SAFETY = 1.25, 3.0
"""Factors of safety with an observed order within `ORDERS`, and with the assumed one."""
MAX_FILE_BYTES = 10_000_000
FILE = "swimmer-refinements.json"
"""Name of the file in the folders of `_folders`."""


class GridSpeed(Struct, frozen=True, kw_only=True):
    """Speed of a swim on one grid."""

    cell: Annotated[float, Meta(gt=0.0)]
    """Size of the cells around the fish [m]."""
    step: float
    """Time step [s]."""
    speed: float
    """[m/s]"""
    speed_ci95: float | None = None
    """Half-width of the 95 % confidence interval of the mean over beats [m/s]."""


class Refinement(Struct, frozen=True, kw_only=True):
    """The same swim on two or three grids."""

    fish: dict[str, Any]
    """Settings of the fish, without those of the grid."""
    controller: str
    parameters: dict[str, Any]
    settled: bool
    """Whether the speeds are steady; otherwise they are those of beats 2 to 4 from rest."""
    grids: Annotated[tuple[GridSpeed, ...], Meta(min_length=2, max_length=3)]
    """Speeds, the coarsest grid first."""

    @property
    def gait(self) -> tuple[Any, ...]:
        """Fish and controller."""
        return self.fish, self.controller, self.parameters

    @property
    def series(self) -> tuple[Any, ...]:
        """Start and sizes of the cells; the speeds of two gaits with the same are comparable."""
        return self.settled, *(grid.cell for grid in self.grids)


class Ratio(Struct, frozen=True):
    """Ratio of the speed of a gait to that of another one of the same fish, on the finest grid."""

    controller: str
    """Controller of the other gait."""
    parameters: dict[str, Any]
    ratio: float
    grid_error: float
    """Half-width of the error of `ratio` by the grid."""


class Estimate(NamedTuple):
    """Limit of the speed for small cells, and its error on a grid."""

    order: float | None
    """Observed order; None for two grids, or where differences grow or change sign."""
    is_converging: bool
    """Whether three grids show an order within `ORDERS`."""
    limit: float
    """Speed that the finest two grids extrapolate to [m/s]."""
    coefficient: float
    """Error per cell size to the power of `used_order`, with the factor of safety."""
    used_order: float

    def error(self, cell: float) -> float:
        """Return the half-width of the error on a grid with such cells [m/s]."""
        return float(self.coefficient * cell**self.used_order)


def estimate(grids: Sequence[GridSpeed]) -> Estimate:
    """Return the estimate from two or three grids, the coarsest first."""
    finest = grids[-1]
    change = finest.speed - grids[-2].speed
    ratio = grids[-2].cell / finest.cell
    order = _observed_order(grids) if len(grids) > 2 else None
    is_converging = order is not None and ORDERS[0] <= order <= ORDERS[1]
    used = min(order, MAX_ORDER) if order and is_converging else ASSUMED_ORDER
    difference = change / (ratio**used - 1.0)
    safety = SAFETY if is_converging else CAUTIOUS_SAFETY
    coefficient = safety * abs(difference) / finest.cell**used
    return Estimate(order, is_converging, finest.speed + difference, coefficient, used)


def relative_error(grids: Sequence[GridSpeed], cell: float) -> float:
    """Return the half-width of the error on a grid with such cells, over the speed there.

    grids: two or three with positive speeds, the coarsest first
    """
    nearest = min(grids, key=lambda grid: abs(math.log(grid.cell / cell)))
    return estimate(grids).error(cell) / nearest.speed


def divide(gait: Refinement, other: Refinement) -> tuple[GridSpeed, ...]:
    """Return the ratio of two speeds on each grid, in place of the speed; both of one series.

    The grid changes both speeds in the same direction, which their ratio does not show.
    """
    pairs = zip(gait.grids, other.grids, strict=True)
    return tuple(replace(grid, speed=grid.speed / over.speed) for grid, over in pairs)


def _observed_order(grids: Sequence[GridSpeed]) -> float | None:
    """Return the order p at which three speeds lie on speed = limit + c · cell^p."""
    coarse, middle, fine = grids[-3:]
    first, second = middle.speed - coarse.speed, fine.speed - middle.speed
    if first * second <= 0.0:
        return None

    def excess(order: float) -> float:
        sizes = (coarse.cell**order, middle.cell**order, fine.cell**order)
        return math.log((sizes[0] - sizes[1]) / (sizes[1] - sizes[2])) - math.log(first / second)

    from scipy.optimize import brentq  # takes long to load, in each sweep

    low, high = 1e-3, 10.0
    if excess(low) > 0.0 or excess(high) < 0.0:
        return None
    return float(brentq(excess, low, high))


def choose_grids(config: Config, count: int) -> list[tuple[float, float]]:
    """Return cell [m] and step [s] of grids, the coarsest first.

    They are twice the configured cells, these cells, and with three grids half of them. Steps are
    whole parts of a tick, and not longer in proportion than the configured step.
    """
    numerics = config.swimmer.numerics
    cells = [numerics.cell * factor for factor in (2.0, 1.0, 0.5)[:count]]
    longest = numerics.step / numerics.cell
    return [
        (cell, config.tick / math.ceil(config.tick / (longest * cell) - 1e-6)) for cell in cells
    ]


def describe_fish(config: Config) -> dict[str, Any]:
    """Return the settings on which a swim depends, without those of the grid."""
    swimmer = msgspec.to_builtins(config.swimmer)
    del swimmer["slow_motion"], swimmer["numerics"]
    estimator = config.estimator.kind
    return {"amplitude_limit": config.amplitude_limit, "estimator": estimator, **swimmer}


def find(config: Config, controller: str, parameters: Mapping[str, Any]) -> list[Refinement]:
    """Return the stored refinements of a gait, the best first: a settled one, then finer cells.

    parameters: all parameters of the controller
    Raises `FishdError` for a file that cannot be read.
    """
    gait = describe_fish(config), controller, msgspec.to_builtins(dict(parameters))
    stored = [each for each in load_all() if each.gait == gait]
    return sorted(stored, key=lambda each: (not each.settled, each.grids[-1].cell))


def find_grid_error(config: Config, controller: str, parameters: Mapping[str, Any]) -> float | None:
    """Return the half-width of the error of a speed on this grid, over the speed; None if unknown.

    It is known after `fishctl swimmer refine` of this fish with this controller. Arguments and
    errors are those of `find`.
    """
    stored = find(config, controller, parameters)
    return relative_error(stored[0].grids, config.swimmer.numerics.cell) if stored else None


def save(refinement: Refinement) -> Path:
    """Add a refinement to the file of this user, in the place of an earlier one of the same swim.

    Raise `FishdError` for a file that cannot be read, and OSError.
    """
    path = _folders()[0] / FILE
    others = [each for each in _read(path) if not _is_same_swim(each, refinement)]
    path.parent.mkdir(parents=True, exist_ok=True)
    content = msgspec.json.format(msgspec.json.encode([*others, refinement]), indent=1)
    files.write_atomically(path, content + b"\n")
    return path


def load_all() -> list[Refinement]:
    """Return all stored refinements; those of this user replace those that are shipped."""
    stored: list[Refinement] = []
    for each in [each for folder in _folders() for each in _read(folder / FILE)]:
        if not any(_is_same_swim(each, other) for other in stored):
            stored.append(each)
    return stored


def ratio_error(
    first: Sequence[Refinement], second: Sequence[Refinement], cell: float
) -> float | None:
    """Return the half-width of the error of the ratio of two speeds on a grid, over the ratio.

    first, second: refinements of the two gaits, the best first
    Return None if no two of them swam on the same grids.
    """
    for gait in first:
        for over in second:
            if gait.series == over.series:
                return relative_error(divide(gait, over), cell)
    return None


def find_ratios(refinement: Refinement, stored: Sequence[Refinement]) -> list[Ratio]:
    """Return the ratios to the other stored gaits of this fish that swam on the same grids."""
    ratios = []
    for other in stored:
        is_same = (other.fish, other.series) == (refinement.fish, refinement.series)
        if is_same and other.gait != refinement.gait:
            grids = divide(refinement, other)
            error = estimate(grids).error(grids[-1].cell)
            ratios.append(Ratio(other.controller, other.parameters, grids[-1].speed, error))
    return ratios


def _is_same_swim(first: Refinement, second: Refinement) -> bool:
    return (first.gait, first.series) == (second.gait, second.series)


def _folders() -> list[Path]:
    """Return the folder of this user's refinements, and that of those that are shipped."""
    state = files.expand_user(os.environ.get("XDG_STATE_HOME") or "~/.local/state") / "fishd"
    return [state, files.shipped_folder("config")]


def _read(path: Path) -> list[Refinement]:
    if not path.exists():
        return []
    try:
        content = files.read(path, MAX_FILE_BYTES, "a file of refinements")
        return msgspec.json.decode(content, type=list[Refinement])
    except (files.FileProblem, msgspec.DecodeError) as problem:
        raise FishdError(
            f"{path}: {problem}; correct it, or remove it and run fishctl swimmer refine again"
        ) from None
