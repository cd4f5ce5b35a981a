"""The active controller; whatever its code raises, third-party code too, becomes an Exception."""

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
from fishd.core.foreign_code import call_foreign
from fishd.core.schema import fields_of, units_of
from fishd.core.signals import Observation, Reason

Successor = tuple[str, Controller[Any]]


class ActiveController:
    """The controller that chooses the angle: calls it, replaces it, and reports its changes."""

    def __init__(self, limits: Limits, reporter: Reporter) -> None:
        self._limits = limits
        self._reporter = reporter
        self.name = "hold"
        self.controller: Controller[Any] = Hold(HoldParameters(), limits)
        self.parameters = _encode_parameters(self.controller)
        """Parameters of the controller, as JSON values."""
        self.parameter_units = _parameter_units(self.controller)
        self.wave = _wave_kind(self.name, self.controller, self.parameters)
        """Kind of wave that the controller makes; a new object after each change."""
        self.quantity_units: dict[str, str] = {}
        """Unit of each quantity of the controller, by name."""
        self.fallback: Reason | None = None
        """Reason why this controller took over from the one that was set; None if it did not."""
        self._is_new = False

    def replace(self, name: str, controller: Controller[Any]) -> None:
        """Make a controller the active one; raises what its parameters raise."""
        units = _quantity_units(type(controller))
        former, self.parameters = self.controller, _encode_parameters(controller)
        self.parameter_units = _parameter_units(controller)
        self.name, self.controller, self.fallback, self._is_new = name, controller, None, True
        self.wave = _wave_kind(name, controller, self.parameters)
        self.quantity_units = units
        self.close_controller(former, f"the controller before {name}")

    @property
    def quantities(self) -> dict[str, float]:
        """Quantities of the controller at its latest update; empty before its first one."""
        return {} if self._is_new else values_of(self.controller, self.quantity_units)

    def close_controller(self, controller: Controller[Any], what: str) -> None:
        """Close a controller that will not be active again; what: its description for the log."""
        try:
            call_foreign(controller.close)
        except Exception as error:
            self._reporter.problem(f"{what} could not be closed", error)

    def activate_hold(self) -> None:
        """Make `hold` the active one, at neutral."""
        self.replace("hold", Hold(HoldParameters(), self._limits))

    def hand_over(self, error: ControllerFault, code: str, successor: Successor) -> None:
        """Activate the successor that a controller named when it gave up, and report that."""
        before = self.name
        self.replace(*successor)
        self.fallback = Reason(code, text.line(f"{before} gave up: {text.error_message(error)}"))
        self._reporter.fallback(
            before, self.name, self.parameters, self.parameter_units, self.fallback
        )

    def update(self, observation: Observation) -> Any:
        """Return the instruction angle of the controller, unchecked.

        Raises what the controller raises, so call this through `call_foreign`.
        """
        controller = self.controller
        if self._is_new:
            controller.activate(observation)
            self._is_new = False
        return controller.update(observation)

    def retune(self, parameters: Struct) -> None:
        """Give the controller new, already checked parameters; raises what its `retune` raises."""
        call_foreign(self.controller.retune, parameters)
        self.parameters = _encode_parameters(self.controller)
        self.wave = _wave_kind(self.name, self.controller, self.parameters)
        self._reporter.controller("parameters", self.name, self.parameters, self.parameter_units)


@lru_cache(maxsize=64)
def _quantity_units(controller: type[Controller[Any]]) -> dict[str, str]:
    """Return the unit of each quantity of a controller class, by name."""
    return {quantity.name: quantity.unit for quantity in quantities_of(controller)}


def _parameter_units(controller: Controller[Any]) -> dict[str, str]:
    """Return the unit of each parameter of a controller, by name."""
    kind: type[Struct] = type(controller.parameters)
    return units_of(fields_of(kind))


def fault_and_successor(error: ControllerFault) -> tuple[str, Successor | None]:
    """Return code and successor of a fault, with defaults where a subclass made them invalid."""

    def read() -> tuple[str, Successor | None]:
        code, successor = error.code, error.successor
        if type(code) is not str:
            code = "controller-error"
        if type(successor) is tuple and type(successor[0]) is str:
            name, controller = successor
            if isinstance(controller, Controller):
                return code, (name, controller)
        return code, None

    try:
        return call_foreign(read)
    except Exception:
        return "controller-error", None


def _wave_kind(
    name: str, controller: Controller[Any], parameters: dict[str, Any]
) -> tuple[str, dict[str, Any]]:
    """Return a value that is equal for waves of one kind, whatever their size."""
    likeness = type(controller).same_wave_as
    if not isinstance(likeness, Likeness):
        return name, parameters
    return likeness.name, {
        key: value for key, value in parameters.items() if key not in likeness.ignored_parameters
    }


def _encode_parameters(controller: Controller[Any]) -> dict[str, Any]:
    """Return the parameters of a controller as JSON values.

    Raises what the controller raises, or an Exception.
    """

    def encode() -> dict[str, Any]:
        encoded = msgspec.json.encode(msgspec.structs.asdict(controller.parameters))
        return msgspec.json.decode(encoded, type=dict[str, Any])

    return call_foreign(encode)
