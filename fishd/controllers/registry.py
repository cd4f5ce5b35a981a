"""Registry of controllers, built-in and third-party (entry-point group `fishd.controllers`)."""

import contextlib
from collections.abc import Mapping
from functools import partial
from typing import Any

import msgspec
from msgspec import Struct

from fishd.controllers.base import Controller, Limits
from fishd.controllers.quantities import quantities_of
from fishd.core import text
from fishd.core.errors import ParameterError, UnknownController
from fishd.core.foreign_code import Attempt, call_foreign
from fishd.core.plugins import Plugins
from fishd.core.schema import Problem, UnknownKey, convert, fields_of, suggest, units_of
from fishd.core.signals import ControllerInfo

IMPORT_TIMEOUT_S = 10.0
"""Maximum time to import a package; after that its controllers are omitted [s]."""


_plugins: Plugins[Controller[Any]] = Plugins(
    "controller",
    "fishd.controllers",
    Controller,
    "Parameters",
    {
        "hold": "fishd.controllers.hold:Hold",
        "square": "fishd.controllers.waveform:Square",
        "sine": "fishd.controllers.waveform:Sine",
        "triangle": "fishd.controllers.waveform:Triangle",
        "swing": "fishd.controllers.swing:Swing",
        "thrust": "fishd.controllers.thrust:Thrust",
        "excitation": "fishd.controllers.excitation:Excitation",
        "ppo": "fishd.controllers.policy.controller:Ppo",
        "remote": "fishd.controllers.remote.controller:Remote",
    },
    UnknownController,
)
names, find, try_import = _plugins.names, _plugins.find, _plugins.try_import
"""Functions that return all names, and the class of a name (or raise `UnknownController`), and one
that imports it in a child process first."""


def split_spec(spec: str) -> tuple[str, list[tuple[str, str]]]:
    """Return name and parameters of a text such as `square:frequency=1.7,amplitude=0.3`.

    A value may be a list, such as `frequency=1,1.5,2`: what has no name continues it.
    Raise `ParameterError` if a parameter is not NAME=VALUE.
    """
    name, _, values = spec.partition(":")
    pairs: list[tuple[str, str]] = []
    for word in filter(None, values.split(",")):
        key, equals, value = word.partition("=")
        if pairs and not (equals and key.isidentifier()):
            pairs[-1] = (pairs[-1][0], f"{pairs[-1][1]},{word}")
        elif key in dict(pairs):
            raise ParameterError(f"{spec}: {key} is given twice")
        elif key and equals and value:
            pairs.append((key, value))
        else:
            raise ParameterError(f"{spec}: '{word}' is not valid: NAME=VALUE is needed")
    return name, pairs


def describe(name: str) -> ControllerInfo:
    """Return the description of a controller; raise `UnknownController`."""
    controller = find(name)
    summary = text.line(str(controller.__doc__ or "").strip().partition("\n")[0])
    return ControllerInfo(
        name=name,
        summary=summary,
        parameters=fields_of(controller.Parameters),
        quantities=quantities_of(controller),
    )


def parameter_names(name: str) -> set[str]:
    """Return the names of a controller's parameters; empty if it is not installed."""
    return set(units(name))


def units(name: str) -> dict[str, str]:
    """Return the units of a controller's parameters; empty if it is not installed."""
    try:
        return units_of(fields_of(find(name).Parameters))
    except UnknownController:
        return {}


def describe_all(prefix: str = "") -> list[ControllerInfo]:
    """Describe all controllers that load in time; using another one raises the reason.

    prefix: beginning of their names
    """
    descriptions = []
    for name in filter(lambda name: name.startswith(prefix), names()):
        with contextlib.suppress(UnknownController):
            try_import(name)  # has a time limit of its own
            attempt = Attempt(partial(describe, name))  # the import may never end
            if attempt.wait(IMPORT_TIMEOUT_S) or not attempt.give_up():
                descriptions.append(attempt.result())
    return descriptions


def check(name: str, values: Mapping[str, Any], limits: Limits) -> Struct:
    """Return validated parameters for the controller `name`.

    Raise `UnknownController` and `ParameterError`.
    """
    controller = find(name)
    try:
        parameters = call_foreign(convert, dict(values), controller.Parameters)
    except Problem as problem:
        if isinstance(problem, UnknownKey) and len(problem.path) == 1:
            key = problem.path[0]
            hint = suggest(
                key, [field.name for field in fields_of(controller.Parameters)], listed="it has"
            )
            raise ParameterError(
                f"unknown parameter '{text.quoted(key)}' of controller {name}; {hint}", problem.path
            ) from None
        place = text.quoted(".".join(problem.path)) or "parameters"
        raise ParameterError(f"{name}: {place}: {problem}", problem.path) from None
    try:
        call_foreign(controller.check, parameters, limits)
    except ParameterError as error:
        raise ParameterError(f"{name}: {text.error_message(error)}", error.path) from None
    return parameters


def create(name: str, values: Mapping[str, Any], limits: Limits) -> Controller[Any]:
    """Create a controller; raise `UnknownController`, `ParameterError`."""
    return call_foreign(find(name), check(name, values, limits), limits)


def merge_parameters(controller: Controller[Any], name: str, values: Mapping[str, Any]) -> Struct:
    """Return the controller's parameters with changed `values`, checked; raise `ParameterError`."""
    current = msgspec.structs.asdict(controller.parameters)
    return check(name, {**current, **values}, controller.limits)
