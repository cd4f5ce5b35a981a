"""What a sweep shows: a curve for each controller and setting, and its best point."""

import json
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import msgspec
from msgspec import Struct

from fishd.lab.sweep.folder import SweepFolder
from fishd.lab.sweep.grid import PARAMETER, Point, axis, is_number
from fishd.lab.sweep.peak import Peak, peak
from fishd.lab.sweep.results import Found, Quantity

_SLIP = 5e-3
"""Half beats this near to whole ticks count as such [ticks]."""


class Curve(NamedTuple):
    """Thrust, or speed, over one quantity, all else being the same."""

    label: str
    over: str
    """That quantity, such as `frequency` or `plant.xi`; empty for a single point."""
    points: list[Point]
    x: list[float]
    results: list[Found]
    peak: Peak | None
    """None over nothing, or where no point has a value."""


class WholeTicks(Struct, frozen=True):
    """The best that was measured of the frequencies whose half beats are whole ticks."""

    frequency: float
    """[Hz]"""
    thrust: float
    """[N]"""
    error: float | None
    """Half of its 95 % interval [N]."""
    nearer: float | None
    """Another such frequency that is nearer the best of the curve, and was not measured [Hz]."""


class Best(Struct, frozen=True):
    """The best of a curve, as a program reads it."""

    controller: str
    parameters: dict[str, Any]
    """Those of the highest point that was measured."""
    keys: dict[str, Any]
    over: str
    """What was varied along the curve, such as `frequency` or `plant.xi`; empty for one point."""
    x: float | None
    """The best value of that; None where nothing was varied."""
    x_low: float | None
    """Its 95 % interval; None if the points do not tell it."""
    x_high: float | None
    value: float
    """Of the thrust [N] or the speed [m/s]."""
    error: float | None
    """Half of its 95 % interval."""
    at_edge: bool
    """The highest point is at the edge of the grid: the best may lie beyond."""
    whole_ticks: WholeTicks | None = None
    """Of a curve over frequencies that has some."""


def curves(folder: SweepFolder, found: Sequence[Point]) -> list[Curve]:
    """The curves of the points that were measured.

    Each runs along the quantity that has the most values among the points of its controller. A
    point that has no number there, such as `auto`, is one of its own.
    """
    groups: dict[tuple[str, str], list[Point]] = {}
    axes = {
        name: axis([point for point in found if point.controller == name])
        for name in {point.controller for point in found}
    }
    for point in found:
        if folder.key(point) in folder.results:
            columns = point.columns()
            over = axes[point.controller]
            over = over if is_number(columns.get(over)) else ""
            rest = {name: value for name, value in columns.items() if name != over}
            groups.setdefault((over, json.dumps(rest)), []).append(point)
    return [_curve(folder, group, over, found) for (over, _), group in groups.items()]


def best(curve: Curve) -> Best | None:
    """The best of a curve; None where no point has a value."""
    swum = [
        (result.value, index)
        for index, result in enumerate(curve.results)
        if result.value is not None
    ]
    if not swum:
        return None
    value, index = max(swum)
    point, found = curve.points[index], curve.peak
    return Best(
        controller=point.controller,
        parameters=point.parameters,
        keys=point.keys,
        over=curve.over,
        x=found.x if found else None,
        x_low=found.x_low if found else None,
        x_high=found.x_high if found else None,
        value=found.y if found else value,
        error=found.y_error if found else curve.results[index].error,
        at_edge=found.at_edge if found else False,
    )


def plain(best: Best, quantity: Quantity) -> dict[str, Any]:
    """The best as a program reads it: its value has the name of the quantity."""
    found = msgspec.structs.asdict(best)
    return {quantity.name if name == "value" else name: each for name, each in found.items()}


def whole_ticks(folder: SweepFolder, curve: Curve) -> WholeTicks | None:
    """The best that was measured without dithered half beats; None where nothing was."""
    if curve.over != "frequency" or curve.peak is None or folder.quantity.name != "thrust":
        return None
    tick = float(curve.points[0].keys.get("tick", folder.experiment.header.config["tick"]))
    whole = {
        round(0.5 / x / tick): (thrust, x, result.error)
        for x, result in zip(curve.x, curve.results, strict=True)
        if (thrust := result.value) is not None and x > 0.0 and _is_whole(0.5 / x / tick)
    }
    if not whole:
        return None
    thrust, frequency, error = max(whole.values(), key=lambda each: each[0])
    top = curve.peak.x
    half = 0.5 / top / tick
    around = [ticks for ticks in (math.floor(half), math.ceil(half)) if ticks > 0]
    near = min(around, key=lambda ticks: abs(0.5 / (ticks * tick) - top))
    return WholeTicks(frequency, thrust, error, None if near in whole else 0.5 / (near * tick))


def _is_whole(ticks: float) -> bool:
    """So nearly that no reversal of a short swim slips to another tick."""
    return round(ticks) > 0 and abs(ticks - round(ticks)) < _SLIP


def _curve(folder: SweepFolder, group: list[Point], over: str, all_of: Sequence[Point]) -> Curve:
    results = [folder.results[folder.key(point)] for point in group]
    x = [float(point.columns()[over]) for point in group] if over else []
    swum = [
        (at, result.value, result.error)
        for at, result in zip(x, results, strict=False)
        if result.value is not None
    ]
    top = peak(*map(list, zip(*swum, strict=True))) if swum else None
    label = group[0].label(without={*_shared(all_of), over})
    return Curve(label, over.removeprefix(PARAMETER), group, x, results, top)


def _shared(found: Sequence[Point]) -> set[str]:
    """The columns that tell nothing apart; none where there is one point only."""
    columns = [point.columns() for point in found]
    if len(columns) < 2:
        return set()
    return {
        name
        for name in dict.fromkeys(name for each in columns for name in each)
        if len({str(each[name]) for each in columns if name in each}) == 1
    }
