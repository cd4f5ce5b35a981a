"""Finds controllers, built in and third-party, by the entry-point group `fishd.controllers`."""

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

LONGEST_IMPORT = 10.0
"""How long a package may take to import before its controllers are left out [s]."""


_found: Plugins[Controller[Any]] = Plugins(
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
names, find = _found.names, _found.find
"""All names; and the class of one, or `UnknownController`."""


def split_spec(spec: str) -> tuple[str, list[tuple[str, str]]]:
    """Return name and parameters of a text such as `square:frequency=1.7,amplitude=0.3`.

    Raises `ParameterError` where a parameter is not NAME=VALUE.
    """
    name, _, values = spec.partition(":")
    pairs = []
    for word in filter(None, values.split(",")):
        key, equals, value = word.partition("=")
        if not (key and equals and value):
            raise ParameterError(f"{spec}: '{word}' is not valid: NAME=VALUE is needed")
        pairs.append((key, value))
    return name, pairs


def describe(name: str) -> ControllerInfo:
    """Name, summary, parameters and quantities of a controller; raises `UnknownController`."""
    found = find(name)
    summary = text.line(str(found.__doc__ or "").strip().partition("\n")[0])
    return ControllerInfo(
        name=name,
        summary=summary,
        parameters=fields_of(found.Parameters),
        quantities=quantities_of(found),
    )


def units(name: str) -> dict[str, str]:
    """Return the units of a controller's parameters; none of one that is not installed here."""
    try:
        return units_of(fields_of(find(name).Parameters))
    except UnknownController:
        return {}


def describe_all(prefix: str = "") -> list[ControllerInfo]:
    """Describe all controllers that load in time; a use of one that does not says why.

    prefix: what their names begin with
    """
    found = []
    for name in filter(lambda name: name.startswith(prefix), names()):
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
        parameters = call_foreign(convert, dict(values), found.Parameters)
    except Problem as problem:
        if isinstance(problem, UnknownKey) and len(problem.path) == 1:
            key = problem.path[0]
            hint = suggest(
                key, [field.name for field in fields_of(found.Parameters)], listed="it has"
            )
            raise ParameterError(
                f"unknown parameter '{text.quoted(key)}' of controller {name}; {hint}", problem.path
            ) from None
        what = text.quoted(".".join(problem.path)) or "parameters"
        raise ParameterError(f"{name}: {what}: {problem}", problem.path) from None
    try:
        call_foreign(found.check, parameters, limits)
    except ParameterError as error:
        raise ParameterError(f"{name}: {text.error_message(error)}", error.path) from None
    return parameters


def create(name: str, values: Mapping[str, Any], limits: Limits) -> Controller[Any]:
    """A new controller, ready to be swapped in; raises `UnknownController`, `ParameterError`."""
    return call_foreign(find(name), check(name, values, limits), limits)


def merged(controller: Controller[Any], name: str, values: Mapping[str, Any]) -> Struct:
    """The controller's parameters with `values` changed, checked; raises `ParameterError`."""
    current = msgspec.structs.asdict(controller.parameters)
    return check(name, {**current, **values}, controller.limits)
