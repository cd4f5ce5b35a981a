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
from scipy.optimize import brentq

from fishd.config import Config
from fishd.core import files
from fishd.core.errors import FishdError

MIN_ORDER = 1.0
"""Order for two grids, and the smallest one with which errors are computed: settled speeds of
the default fish have shown orders from 0.4 to 1.5."""
ORDERS = MIN_ORDER, 3.0
"""Range of observed orders in which the speed counts as converging."""
MAX_ORDER = 2.0
"""Largest order with which errors are computed, that of the scheme."""
SAFETY, CAUTIOUS_SAFETY = 1.25, 3.0
"""Factors of safety with an observed order, and with an assumed one or outside `ORDERS`."""
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
    grids: Annotated[tuple[GridSpeed, ...], Meta(min_length=2, max_length=3)]
    """Speeds, the coarsest grid first."""


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
    used = min(max(order or MIN_ORDER, MIN_ORDER), MAX_ORDER)
    difference = change / (ratio**used - 1.0)
    safety = SAFETY if is_converging else CAUTIOUS_SAFETY
    coefficient = safety * abs(difference) / finest.cell**used
    return Estimate(order, is_converging, finest.speed + difference, coefficient, used)


def _observed_order(grids: Sequence[GridSpeed]) -> float | None:
    """Return the order p at which three speeds lie on speed = limit + c · cell^p."""
    coarse, middle, fine = grids[-3:]
    first, second = middle.speed - coarse.speed, fine.speed - middle.speed
    if first * second <= 0.0:
        return None

    def excess(order: float) -> float:
        sizes = (coarse.cell**order, middle.cell**order, fine.cell**order)
        return math.log((sizes[0] - sizes[1]) / (sizes[1] - sizes[2])) - math.log(first / second)

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
    return {"amplitude_limit": config.amplitude_limit, **swimmer}


def find_grid_error(config: Config, controller: str, parameters: Mapping[str, Any]) -> float | None:
    """Return the half-width of the error of a speed on this grid [m/s]; None if not known.

    parameters: all parameters of the controller
    It is known after `fishctl swimmer refine` of this fish with this controller.
    """
    fish, values = describe_fish(config), msgspec.to_builtins(dict(parameters))
    for stored in reversed([each for folder in _folders() for each in _read(folder / FILE)]):
        if (stored.fish, stored.controller, stored.parameters) == (fish, controller, values):
            return estimate(stored.grids).error(config.swimmer.numerics.cell)
    return None


def save(refinement: Refinement) -> Path:
    """Add a refinement to the file of this user, in the place of an earlier one of the same swim.

    Raise `FishdError` for a file that cannot be read, and OSError.
    """
    path = _folders()[-1] / FILE
    swim = refinement.fish, refinement.controller, refinement.parameters
    others = [each for each in _read(path) if (each.fish, each.controller, each.parameters) != swim]
    path.parent.mkdir(parents=True, exist_ok=True)
    content = msgspec.json.format(msgspec.json.encode([*others, refinement]), indent=1)
    files.write_atomically(path, content + b"\n")
    return path


def _folders() -> list[Path]:
    """Return the folder of refinements that are shipped, and the one of this user."""
    state = files.expand_user(os.environ.get("XDG_STATE_HOME") or "~/.local/state") / "fishd"
    return [files.shipped_folder("config"), state]


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
