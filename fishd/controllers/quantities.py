"""A controller's own quantities: internal values that it shows, such as its present frequency."""

from collections.abc import Iterable
from typing import Any

from fishd.core import text
from fishd.core.foreign_code import call_foreign, real_number
from fishd.core.signals import QuantityInfo

MOST = 16
"""Quantities of a controller."""
LONGEST_NAME = 40
"""[characters]"""


class _Declared:
    """Of no account once a controller has a value of its own: its attribute comes first."""

    def __init__(self, unit: str, description: str) -> None:
        self.unit, self.description = unit, description
        self._name = ""

    def __set_name__(self, _: type[Any], name: str) -> None:
        self._name = name

    def __get__(self, controller: object, _: type[Any] | None = None) -> Any:
        if controller is None:
            return self
        raise AttributeError(
            f"quantity '{self._name}' has no value before one is assigned to it, such as "
            f"self.{self._name} = 0.0 in __init__",
            name=self._name,
            obj=controller,
        )


def quantity(unit: str, description: str) -> Any:
    """An attribute that everybody sees: in telemetry, recordings and plots.

    `frequency: float = quantity("Hz", "Present frequency of the sweep.")` in the class of a
    controller, and `self.frequency = 1.5` wherever it changes. What it is after `update` goes into
    the tick. It is left out before it is assigned, and while it is None or no finite real number;
    to read it before it is assigned raises AttributeError.

    unit: in SI notation, `1` for a pure number
    description: one sentence
    """
    return _Declared(unit, description)


def quantities_of(controller: type[Any]) -> tuple[QuantityInfo, ...]:
    """What the quantities of a class of controllers are called and mean, its bases' first.

    Raises TypeError where they cannot be shown: too many of them, or too long a name.
    """
    found = dict(_declarations(controller))
    if len(found) > MOST:
        raise TypeError(f"it has {len(found)} quantities; at most {MOST} are possible")
    for name, declared in found.items():
        if not name.isidentifier() or len(name) > LONGEST_NAME:
            raise TypeError(
                f"'{text.quoted(name)}' cannot name a quantity: a Python name of at most "
                f"{LONGEST_NAME} characters is needed"
            )
        if not (isinstance(declared.unit, str) and isinstance(declared.description, str)):
            raise TypeError(f"unit and description of quantity '{name}' must be texts")
    return tuple(
        QuantityInfo(name, text.quoted(declared.unit), text.line(declared.description))
        for name, declared in found.items()
    )


def values_of(controller: object, names: Iterable[str]) -> dict[str, float]:
    """What these quantities of a controller are now; without those that are no finite number."""
    held, found = controller.__dict__, {}
    for name in names:
        if name not in held:
            continue
        value = held[name]
        if type(value) is not float:
            if value is None:
                continue
            try:
                value = call_foreign(real_number, value, name)
            except Exception:  # which costs no more than the quantity
                continue
        if value - value == 0.0:  # it is finite
            found[name] = value
    return found


def _declarations(controller: type[Any]) -> Iterable[tuple[str, _Declared]]:
    for base in reversed(controller.__mro__):
        for name, value in vars(base).items():
            if isinstance(value, _Declared):
                yield name, value
