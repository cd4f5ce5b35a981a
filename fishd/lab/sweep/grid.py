"""The points of a sweep: every combination of controllers, parameter values and configured keys.

And for how long a simulated fish swims at each.
"""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from typing import Any

from msgspec import Struct

from fishd.config import Config
from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.core.errors import ParameterError
from fishd.core.schema import format_quantity, format_values, unit_at

MOST = 100_000
"""A grid has no more points."""
_WHOLE = 2.0**53
"""Below this, a number that is whole is exact."""
PARAMETER = "parameters."
"""What the column of a controller's parameter begins with; that of a configured key is its name."""


class Point(Struct, frozen=True):
    """One thing to measure."""

    controller: str
    parameters: dict[str, Any]
    """Those that were given; the others have their defaults."""
    keys: dict[str, Any] = {}
    """Keys of the configuration that differ from that of the sweep, in dotted form."""

    def columns(self) -> dict[str, Any]:
        """Its columns in a table, by name."""
        parameters = {PARAMETER + name: value for name, value in self.parameters.items()}
        return {"controller": self.controller, **parameters, **self.keys}

    def label(self, *, without: Collection[str] = ()) -> str:
        """`square frequency=1.4 Hz amplitude=0.3 rad`: its columns in a line, but for some."""
        units = registry.units(self.controller)
        values = {
            PARAMETER + name: (value, units.get(name, ""))
            for name, value in self.parameters.items()
        }
        values |= {key: (value, unit_at(Config, key)) for key, value in self.keys.items()}
        words = (
            f"{name.removeprefix(PARAMETER)}={format_quantity(value, unit)}"
            for name, (value, unit) in values.items()
            if name not in without
        )
        return " ".join((self.controller, *words))


class Lengths(Struct, frozen=True):
    """How long a simulated fish swims at each point."""

    settle: float = 10.0
    """Not judged [s]; a free swimmer takes longer where it has to."""
    periods: int = 20
    """Tail beats that are judged; of a free swimmer, at least."""

    @classmethod
    def of(cls, config: Config, settle: float | None, periods: int | None) -> "Lengths":
        """As given, or as is usual with such a fish."""
        usual = cls(4.0, 10) if config.robot == "swimmer" else cls()
        return cls(
            usual.settle if settle is None else settle,
            usual.periods if periods is None else periods,
        )


def spread(text: str) -> list[str]:
    """The values of `0.4:4:0.2` (low:high:step, both ends included) or of a list `0.3,0.6,1`.

    Each is a text, exact in decimals. Raises `ParameterError`.
    """
    found: list[str] = []
    for piece in text.split(","):
        piece = piece.strip()
        found += _range(piece) if ":" in piece else [piece]
        if len(found) > MOST:
            raise ParameterError(f"'{text}' has more than {MOST} values")
    if "" in found:
        raise ParameterError(f"'{text}' is not valid: a value is missing in it")
    return list(dict.fromkeys(found))


def typed(text: str) -> int | float | str:
    """A number where it is one: a whole one without a fraction; else the text itself."""
    try:
        number = float(text)
    except ValueError:
        return text
    if not math.isfinite(number):
        return text
    return int(number) if number.is_integer() and abs(number) < _WHOLE else number


def _range(piece: str) -> list[str]:
    try:
        low, high, step = (Decimal(part) for part in piece.split(":"))
        if step <= 0 or high < low or not (high - low).is_finite():
            raise ValueError(piece)
        count = int((high - low) / step + Decimal("1e-9")) + 1
    except (ValueError, InvalidOperation, OverflowError):
        raise ParameterError(
            f"'{piece}' is not valid: LOW:HIGH:STEP is needed, such as 0.4:4:0.2"
        ) from None
    if count > MOST:
        raise ParameterError(f"'{piece}' has more than {MOST} values")
    return [str((low + k * step).normalize()) for k in range(count)]


def points(
    controllers: Sequence[str],
    parameters: Mapping[str, Sequence[Any]],
    takes: Mapping[str, Sequence[str]],
    keys: Mapping[str, Sequence[Any]] | None = None,
) -> list[Point]:
    """Every combination, in order: the last parameter changes first.

    parameters: the values of each
    takes: the names of the parameters of each controller; one that it does not know is left out
    keys: the values of each key of the configuration

    Raises `ParameterError` for a parameter that no controller has, and for too many points.
    """
    keys = keys or {}
    for name in parameters:
        if not any(name in takes[each] for each in controllers):
            if len(controllers) == 1:
                raise ParameterError(f"{controllers[0]} has no parameter '{name}'")
            raise ParameterError(f"none of {', '.join(controllers)} has a parameter '{name}'")
    found = []
    for changed in _combinations(keys):
        for controller in dict.fromkeys(controllers):
            own = {name: parameters[name] for name in parameters if name in takes[controller]}
            found += [Point(controller, given, changed) for given in _combinations(own)]
            if len(found) > MOST:
                raise ParameterError(f"this grid has more than {MOST} points")
    return found


def _combinations(values: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    count = 1
    for each in values.values():
        count *= len(each)
    if count > MOST:
        raise ParameterError(f"this grid has more than {MOST} points")
    return [
        dict(zip(values, combination, strict=True))
        for combination in itertools.product(*values.values())
    ]


def check(point: Point, limits: Limits) -> None:
    """Raises `ParameterError` and `UnknownController` where it cannot swim within these limits."""
    try:
        registry.check(point.controller, point.parameters, limits)
    except ParameterError as error:
        where = format_values(point.keys, {key: unit_at(Config, key) for key in point.keys})
        raise ParameterError(f"{error}{f' (with {where})' if where else ''}", error.path) from None


def check_remote(found: Sequence[Point], limits: Limits) -> None:
    """The same for a fishd that may run on another machine.

    What only that can tell is left to it: a controller that is not installed here, a file.
    """
    names = registry.names()
    for point in found:
        if point.controller not in names:
            continue
        fields = registry.describe(point.controller).parameters
        if not any(field.file and field.name in point.parameters for field in fields):
            check(point, limits)


def axis(found: Sequence[Point]) -> str:
    """The column to draw results over: the number with the most values; empty where all agree."""
    values: dict[str, set[Any]] = {}
    for point in found:
        for name, value in point.columns().items():
            if is_number(value):
                values.setdefault(name, set()).add(value)
    counts = {name: len(each) for name, each in values.items() if len(each) > 1}
    return max(counts, key=lambda name: counts[name]) if counts else ""


def is_number(value: Any) -> bool:
    """Can results be drawn over it?"""
    return isinstance(value, int | float) and not isinstance(value, bool)
