"""Finds controllers, built in and third-party, by the entry-point group `fishd.controllers`."""

import contextlib
from collections.abc import Mapping
from functools import cache, partial
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import Struct

from fishd import text
from fishd.contained import Attempt, contained
from fishd.controllers.base import Controller, Limits
from fishd.errors import ParameterError, UnknownController
from fishd.schema import Problem, convert, fields_of, nearest
from fishd.signals import ControllerInfo

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "fishd.controllers"
LONGEST_IMPORT = 10.0
"""How long a package may take to import before its controllers are left out [s]."""


@cache
def _entries() -> "dict[str, EntryPoint]":
    from importlib.metadata import entry_points  # a third of the time that `fishctl status` takes

    return {entry.name: entry for entry in entry_points(group=GROUP)}


def names() -> list[str]:
    """The names of all installed controllers."""
    return sorted(_entries())


@cache
def find(name: str) -> type[Controller[Any]]:
    """The class of the controller `name`.

    Raises `UnknownController`, also where the package that offers it does not load.
    """
    if name not in _entries():
        hint = nearest(name, names())
        raise UnknownController(f"no controller is named '{text.quoted(name)}'; {hint}")
    entry = _entries()[name]
    try:
        found = contained(entry.load)
    except Exception as error:
        raise UnknownController(
            f"controller '{name}' ({entry.value}) does not load: {text.named(error)}"
        ) from error
    if not (isinstance(found, type) and issubclass(found, Controller)):
        raise UnknownController(
            f"controller '{name}' ({entry.value}) is no subclass of "
            "fishd.controllers.base.Controller"
        )
    parameters = getattr(found, "Parameters", None)
    if not (isinstance(parameters, type) and issubclass(parameters, Struct)):
        raise UnknownController(
            f"controller '{name}' ({entry.value}) has no Parameters, a msgspec.Struct"
        )
    try:
        contained(msgspec.json.encode, fields_of(parameters))
    except Exception as error:
        raise UnknownController(
            f"controller '{name}' ({entry.value}) has Parameters that cannot be read: "
            f"{text.named(error)}"
        ) from error
    return found


def describe(name: str) -> ControllerInfo:
    """Name, summary and parameters of one controller; raises `UnknownController`."""
    found = find(name)
    summary = text.line(str(found.__doc__ or "").strip().partition("\n")[0])
    return ControllerInfo(name=name, summary=summary, parameters=fields_of(found.Parameters))


def describe_all() -> list[ControllerInfo]:
    """All controllers that load in time; the name of one that does not says why when it is used."""
    found = []
    for name in names():
        attempt = Attempt(partial(describe, name))  # of a package that may never come back
        if attempt.wait(LONGEST_IMPORT) or not attempt.give_up():
            with contextlib.suppress(UnknownController):
                found.append(attempt.result())
    return found


def check(name: str, values: Mapping[str, Any], limits: Limits) -> Struct:
    """Validated parameters for the controller `name`.

    Raises `UnknownController` and `ParameterError`.
    """
    found = find(name)
    try:
        parameters = contained(convert, dict(values), found.Parameters)
    except Problem as problem:
        what = text.quoted(".".join(problem.path)) or "parameters"
        raise ParameterError(f"{name}: {what}: {problem}", problem.path) from None
    try:
        contained(found.check, parameters, limits)
    except ParameterError as error:
        raise ParameterError(f"{name}: {text.said(error)}", error.path) from None
    return parameters


def create(name: str, values: Mapping[str, Any], limits: Limits) -> Controller[Any]:
    """A new controller, ready to be swapped in; raises `UnknownController`, `ParameterError`."""
    return contained(find(name), check(name, values, limits), limits)


def merged(controller: Controller[Any], name: str, values: Mapping[str, Any]) -> Struct:
    """The controller's parameters with `values` changed, checked; raises `ParameterError`."""
    current = msgspec.structs.asdict(controller.parameters)
    return check(name, {**current, **values}, controller.limits)
