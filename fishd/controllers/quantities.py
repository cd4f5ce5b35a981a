"""Quantities of controllers: internal values for display, such as the current frequency."""

from collections.abc import Iterable
from typing import Any

from fishd.core import text
from fishd.core.foreign_code import call_foreign, real_number
from fishd.core.signals import QuantityInfo

MAX_QUANTITIES = 16
"""Maximum number of quantities of a controller."""
MAX_NAME_CHARACTERS = 40
"""Maximum length of the name of a quantity [characters]."""


class _Declared:
    """Declaration of a quantity; an instance attribute with a value takes precedence over it."""

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
    """Declare an attribute that is published in telemetry, recordings and plots.

    Write `frequency: float = quantity("Hz", "Current frequency of the sweep.")` in the class of a
    controller, and `self.frequency = 1.5` wherever it changes. The tick gets its value after
    `update`. It is omitted before the first assignment, and while it is None or not a finite real
    number; reading it before the first assignment raises AttributeError.

    unit: unit in SI notation, `1` for a pure number
    description: one sentence
    """
    return _Declared(unit, description)


def quantities_of(controller: type[Any]) -> tuple[QuantityInfo, ...]:
    """Return the descriptions of the quantities of a controller class, those of its bases first.

    Raise TypeError for too many quantities, or an invalid name.
    """
    declarations = dict(_declarations(controller))
    if len(declarations) > MAX_QUANTITIES:
        raise TypeError(
            f"it has {len(declarations)} quantities; at most {MAX_QUANTITIES} are possible"
        )
    for name, declaration in declarations.items():
        if not name.isidentifier() or len(name) > MAX_NAME_CHARACTERS:
            raise TypeError(
                f"'{text.quoted(name)}' cannot name a quantity: a Python name of at most "
                f"{MAX_NAME_CHARACTERS} characters is needed"
            )
        if not (isinstance(declaration.unit, str) and isinstance(declaration.description, str)):
            raise TypeError(f"unit and description of quantity '{name}' must be texts")
    return tuple(
        QuantityInfo(name, text.quoted(declaration.unit), text.line(declaration.description))
        for name, declaration in declarations.items()
    )


def values_of(controller: object, names: Iterable[str]) -> dict[str, float]:
    """Return the current values of these quantities of a controller, if they are finite numbers."""
    attributes, values = controller.__dict__, {}
    for name in names:
        if name not in attributes:
            continue
        value = attributes[name]
        if type(value) is not float:
            if value is None:
                continue
            try:
                value = call_foreign(real_number, value, name)
            except Exception:  # affects only this quantity
                continue
        if value - value == 0.0:  # it is finite
            values[name] = value
    return values


def _declarations(controller: type[Any]) -> Iterable[tuple[str, _Declared]]:
    for base in reversed(controller.__mro__):
        for name, value in vars(base).items():
            if isinstance(value, _Declared):
                yield name, value
