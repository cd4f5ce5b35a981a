"""Points of a sweep: every combination of controllers, parameter values and configuration keys.

Also the duration for which a simulated fish swims at each point.
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

MAX_POINTS = 100_000
"""Largest number of points of a grid."""
_EXACT_INTEGER_LIMIT = 2.0**53
"""Limit below which a float that is an integer is exact."""
PARAMETER_PREFIX = "parameters."
"""Prefix of the column of a controller's parameter; the column of a configuration key has none."""


class Point(Struct, frozen=True):
    """One point to measure: a controller, its parameters and the configuration of the fish."""

    controller: str
    parameters: dict[str, Any]
    """Parameters that were given; the others have their defaults."""
    keys: dict[str, Any] = {}
    """Keys that differ from the configuration of the sweep, in dotted form, with their values."""

    def columns(self) -> dict[str, Any]:
        """Return the values of the point's columns in a table, by name."""
        parameters = {PARAMETER_PREFIX + name: value for name, value in self.parameters.items()}
        return {"controller": self.controller, **parameters, **self.keys}

    def label(self, *, without: Collection[str] = ()) -> str:
        """Return the columns, except those in `without`, as in `square frequency=1.4 Hz`."""
        units = registry.units(self.controller)
        values = {
            PARAMETER_PREFIX + name: (value, units.get(name, ""))
            for name, value in self.parameters.items()
        }
        values |= {key: (value, unit_at(Config, key)) for key, value in self.keys.items()}
        words = (
            f"{name.removeprefix(PARAMETER_PREFIX)}={format_quantity(value, unit)}"
            for name, (value, unit) in values.items()
            if name not in without
        )
        return " ".join((self.controller, *words))


class Lengths(Struct, frozen=True):
    """Duration for which a simulated fish swims at each point."""

    settle: float = 10.0
    """Time at the start that is not measured [s]; a free fish may need longer."""
    periods: int = 20
    """Number of measured tail beats; for a free fish, the smallest number."""

    @classmethod
    def of(cls, config: Config, settle: float | None, periods: int | None) -> "Lengths":
        """Return the given durations; None selects the default for the kind of fish."""
        usual = cls() if config.kind.is_tethered else cls(4.0, 10)
        return cls(
            usual.settle if settle is None else settle,
            usual.periods if periods is None else periods,
        )


def expand_values(text: str) -> list[str]:
    """Return the values of `0.4:4:0.2` (low:high:step, with both ends) or of a list `0.3,0.6,1`.

    The values are texts, exact in decimals. Raises `ParameterError`.
    """
    values: list[str] = []
    for piece in text.split(","):
        piece = piece.strip()
        values += _expand_range(piece) if ":" in piece else [piece]
        if len(values) > MAX_POINTS:
            raise ParameterError(f"'{text}' has more than {MAX_POINTS} values")
    if "" in values:
        raise ParameterError(f"'{text}' is not valid: a value is missing in it")
    return list(dict.fromkeys(values))


def parse_value(text: str) -> int | float | str:
    """Return the number that the text stands for, an int if it is whole; else the text itself."""
    try:
        number = float(text)
    except ValueError:
        return text
    if not math.isfinite(number) or "_" in text:
        return text
    return int(number) if number.is_integer() and abs(number) < _EXACT_INTEGER_LIMIT else number


def _expand_range(piece: str) -> list[str]:
    try:
        low, high, step = (Decimal(part) for part in piece.split(":"))
        if step <= 0 or high < low or not (high - low).is_finite():
            raise ValueError(piece)
        count = int((high - low) / step + Decimal("1e-9")) + 1
    except (ValueError, InvalidOperation, OverflowError):
        raise ParameterError(
            f"'{piece}' is not valid: LOW:HIGH:STEP is needed, with LOW up to HIGH and a positive "
            "STEP, such as 0.4:4:0.2"
        ) from None
    if count > MAX_POINTS:
        raise ParameterError(f"'{piece}' has more than {MAX_POINTS} values")
    return [str((low + k * step).normalize()) for k in range(count)]


def make_points(
    controllers: Sequence[str],
    parameters: Mapping[str, Sequence[Any]],
    accepted: Mapping[str, Sequence[str]],
    keys: Mapping[str, Sequence[Any]] | None = None,
) -> list[Point]:
    """Return every combination, in order; the last parameter changes fastest.

    parameters: values of each parameter
    accepted: names of the parameters of each controller; a controller ignores the others
    keys: values of each key of the configuration

    Raises `ParameterError` for a parameter that no controller has, and for too many points.
    """
    keys = keys or {}
    for name in parameters:
        if not any(name in accepted[candidate] for candidate in controllers):
            if len(controllers) == 1:
                raise ParameterError(f"{controllers[0]} has no parameter '{name}'")
            raise ParameterError(f"none of {', '.join(controllers)} has a parameter '{name}'")
    grid = []
    for key_values in _combine(keys):
        for controller in dict.fromkeys(controllers):
            values = {name: parameters[name] for name in parameters if name in accepted[controller]}
            grid += [Point(controller, given, key_values) for given in _combine(values)]
            if len(grid) > MAX_POINTS:
                raise ParameterError(f"this grid has more than {MAX_POINTS} points")
    return grid


def _combine(values: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    count = 1
    for options in values.values():
        count *= len(options)
    if count > MAX_POINTS:
        raise ParameterError(f"this grid has more than {MAX_POINTS} points")
    return [
        dict(zip(values, combination, strict=True))
        for combination in itertools.product(*values.values())
    ]


def check(point: Point, limits: Limits) -> None:
    """Raise `ParameterError` or `UnknownController` if the point does not fit these limits."""
    try:
        registry.check(point.controller, point.parameters, limits)
    except ParameterError as error:
        where = format_values(point.keys, {key: unit_at(Config, key) for key in point.keys})
        raise ParameterError(f"{error}{f' (with {where})' if where else ''}", error.path) from None


def check_remote(points: Sequence[Point], limits: Limits) -> None:
    """Check points for a fishd that may run on another machine, as `check` does.

    Points that only that fishd can check are skipped: controllers not installed here, and files.
    """
    names = registry.names()
    for point in points:
        if point.controller not in names:
            continue
        fields = registry.describe(point.controller).parameters
        if not any(field.file and field.name in point.parameters for field in fields):
            check(point, limits)


def find_axis(points: Sequence[Point]) -> str:
    """Return the column for the horizontal axis: the numeric column with the most values.

    Return an empty text if no column has two values.
    """
    values: dict[str, set[Any]] = {}
    for point in points:
        for name, value in point.columns().items():
            if is_number(value):
                values.setdefault(name, set()).add(value)
    counts = {name: len(distinct) for name, distinct in values.items() if len(distinct) > 1}
    return max(counts, key=lambda name: counts[name]) if counts else ""


def is_number(value: Any) -> bool:
    """Return whether a value is a number, so that results can be drawn over it."""
    return isinstance(value, int | float) and not isinstance(value, bool)
