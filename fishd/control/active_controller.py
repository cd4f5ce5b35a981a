"""The active controller. It may be anybody's code, so whatever it raises becomes an Exception."""

from functools import lru_cache
from typing import Any

import msgspec
from msgspec import Struct

from fishd.control.reporting import Reporter
from fishd.controllers.base import Controller, Likeness, Limits
from fishd.controllers.hold import Hold, HoldParameters
from fishd.controllers.quantities import quantities_of, values_of
from fishd.core import text
from fishd.core.errors import ControllerFault
from fishd.core.foreign_code import contained
from fishd.core.schema import fields_of, units_of
from fishd.core.signals import Observation, Reason

Successor = tuple[str, Controller[Any]]


class ActiveController:
    """Calls the controller that chooses the angle, replaces it, and tells of either."""

    def __init__(self, limits: Limits, reporter: Reporter) -> None:
        self._limits = limits
        self._reporter = reporter
        self.name = "hold"
        self.controller: Controller[Any] = Hold(HoldParameters(), limits)
        self.parameters = _plain(self.controller)
        """Its parameters, as JSON has them."""
        self.parameter_units = _parameter_units(self.controller)
        self.wave = _wave(self.name, self.controller, self.parameters)
        """Which kind of wave it makes, as another object after each change."""
        self.quantity_units: dict[str, str] = {}
        """The units of all that it has."""
        self.fallback: Reason | None = None
        """Why it took over from the controller that was set, if it did."""
        self._fresh = False

    def replace(self, name: str, controller: Controller[Any]) -> None:
        """Make a ready-made controller the active one; raises what its parameters raise."""
        units = _units(type(controller))
        former, self.parameters = self.controller, _plain(controller)
        self.parameter_units = _parameter_units(controller)
        self.name, self.controller, self.fallback, self._fresh = name, controller, None, True
        self.wave = _wave(name, controller, self.parameters)
        self.quantity_units = units
        self.dispose(former, f"the controller before {name}")

    @property
    def quantities(self) -> dict[str, float]:
        """Its own, since its latest update; empty where it has none to show."""
        return {} if self._fresh else values_of(self.controller, self.quantity_units)

    def dispose(self, controller: Controller[Any], what: str) -> None:
        """Close a controller that will not be active any more."""
        try:
            contained(controller.close)
        except Exception as error:
            self._reporter.problem(f"{what} could not be closed", error)

    def rest(self) -> None:
        """Make `hold` the active one, at neutral."""
        self.replace("hold", Hold(HoldParameters(), self._limits))

    def succeed(self, error: ControllerFault, code: str, successor: Successor) -> None:
        """The active controller gave up and named another one, which becomes active."""
        before = self.name
        self.replace(*successor)
        self.fallback = Reason(code, text.line(f"{before} gave up: {text.said(error)}"))
        self._reporter.fallback(
            before, self.name, self.parameters, self.parameter_units, self.fallback
        )

    def update(self, observation: Observation) -> Any:
        """Return what it commands, unchecked; raises what it raises, so call this `contained`."""
        controller = self.controller
        if self._fresh:
            controller.activate(observation)
            self._fresh = False
        return controller.update(observation)

    def retune(self, parameters: Struct) -> None:
        """Give it new, already checked parameters; raises what it raises."""
        contained(self.controller.retune, parameters)
        self.parameters = _plain(self.controller)
        self.wave = _wave(self.name, self.controller, self.parameters)
        self._reporter.controller("parameters", self.name, self.parameters, self.parameter_units)

    def warm_up(self) -> None:
        """Let it warm up for the next update, which is imminent; raises what it raises."""
        contained(self.controller.warm_up)


@lru_cache(maxsize=64)
def _units(controller: type[Controller[Any]]) -> dict[str, str]:
    """The units of its quantities, by name; of a class, which does not change."""
    return {each.name: each.unit for each in quantities_of(controller)}


def _parameter_units(controller: Controller[Any]) -> dict[str, str]:
    """Return the units of its parameters, by name."""
    kind: type[Struct] = type(controller.parameters)
    return units_of(fields_of(kind))


def told(error: ControllerFault) -> tuple[str, Successor | None]:
    """Code and successor of a fault, whatever a subclass has made of them."""

    def look() -> tuple[str, Successor | None]:
        code, successor = error.code, error.successor
        if type(code) is not str:
            code = "controller-error"
        if type(successor) is tuple and type(successor[0]) is str:
            name, controller = successor
            if isinstance(controller, Controller):
                return code, (name, controller)
        return code, None

    try:
        return contained(look)
    except Exception:
        return "controller-error", None


def _wave(
    name: str, controller: Controller[Any], parameters: dict[str, Any]
) -> tuple[str, dict[str, Any]]:
    """Waves that are equal are of one kind, though not always of one size."""
    like = type(controller).swims_like
    if not isinstance(like, Likeness):
        return name, parameters
    return like.name, {key: each for key, each in parameters.items() if key not in like.but_for}


def _plain(controller: Controller[Any]) -> dict[str, Any]:
    """The parameters of a controller as JSON has them; raises what it raises, or an Exception."""

    def plain() -> dict[str, Any]:
        encoded = msgspec.json.encode(msgspec.structs.asdict(controller.parameters))
        return msgspec.json.decode(encoded, type=dict[str, Any])

    return contained(plain)
