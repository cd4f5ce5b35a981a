"""Options of the experiments of a page, and the command lines that a person would type for them.

The forms are those of `fishctl window forms`. A page gives no words of a command line, only values
that are checked here.
"""

from collections.abc import Collection, Iterator
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from fishd.core import text
from fishd.core.errors import ParameterError
from fishd.core.experiments import Form, FormField, Plan
from fishd.core.schema import PRINTABLE
from fishd.core.signals import ControllerInfo

Name = Annotated[str, Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*\Z", max_length=60)]
Contestant = Annotated[
    str, Meta(pattern=r"^[A-Za-z0-9_.~/][A-Za-z0-9_.:,+=~/-]*\Z", max_length=200)
]
RunName = Annotated[str, Meta(pattern=r"^\w[\w. -]*\Z", max_length=100)]
Line = Annotated[str, Meta(pattern=PRINTABLE, max_length=500)]
Word = Annotated[str, Meta(pattern=r"^(-?[0-9.:]|[A-Za-z_])[A-Za-z0-9_.:,+=-]*\Z", max_length=200)]
Value = bool | int | float | Line | None
MAX_NUMBER = 1e9
"""Largest magnitude of a number that has no bounds."""
_ARGUMENTS: dict[str, tuple[Any, ...]] = {
    "controller": ("controller", Name),
    "contestants": ("contestants", Annotated[list[Contestant], Meta(max_length=20)], []),
    "recordings": ("recordings", Annotated[list[RunName], Meta(max_length=20)], []),
    "run": ("run", RunName),
    "name": ("name", RunName | None, None),
}


class ResumeOptions(Struct, forbid_unknown_fields=True):
    """Options of resume: the folder of an experiment that is not complete."""

    run: RunName
    take: bool = False


QUEUE = Form("queue", "Queue", ["queue", "start"], "Run the queue.")
"""The runner of the queue, whose experiments have their own folders; not among the forms."""


class QueueOptions(Struct, forbid_unknown_fields=True):
    """Options of the runner of the queue."""

    take: bool = False
    on: Literal["live"] = "live"


def make_options(form: Form) -> type[Struct]:
    """Return a new struct of the options of a form."""
    fields: list[Any] = [_ARGUMENTS[form.argument]] if form.argument else []
    if form.kind == "rerun":
        fields.append(("controller", Name | None, None))
    if form.values or form.kind == "rerun":
        fields.append(("parameters", dict[Name, Value], {}))
    if form.is_experiment:
        fields.append(("take", bool, False))
    for field in form.fields:
        default = field.default if field.name == "on" else None
        fields.append((field.name, _type_of(field) | None, default))
    return msgspec.defstruct(f"{form.kind}_options", fields, forbid_unknown_fields=True)


def _type_of(field: FormField) -> Any:
    if field.kind in ("number", "integer"):
        kind: Any = int if field.kind == "integer" else float
        low = kind(-MAX_NUMBER if field.low is None else field.low)
        high = kind(MAX_NUMBER if field.high is None else field.high)
        bounds = {"gt" if field.low_open else "ge": low, "lt" if field.high_open else "le": high}
        return Annotated[kind, Meta(**bounds)]
    if field.kind == "choice":
        return Literal[field.choices]
    return bool if field.kind == "boolean" else Line


def swims(form: Form, options: Any) -> bool:
    """Return whether an experiment swims a fish, and so has a folder."""
    return form.is_experiment and not getattr(options, "recordings", ())


def check_parameters(options: Any, controllers: Collection[ControllerInfo]) -> None:
    """Raise `ParameterError` unless each parameter is one of the controller, with a safe value.

    So a name is not one of the verb's own options. A path has the suffix that the controller reads.
    """
    fields = {
        field.name: field
        for info in controllers
        if info.name == options.controller
        for field in info.parameters
    }
    for name, value in options.parameters.items():
        if name not in fields:
            raise ParameterError(f"{options.controller} has no parameter '{text.quoted(name)}'")
        suffix = fields[name].file
        if isinstance(value, str) and not (suffix and value.endswith(suffix) and value[0] != "-"):
            try:
                msgspec.convert(value, Word)
            except msgspec.ValidationError:
                needed = (
                    f"a name or the path of a {suffix} file is needed"
                    if suffix
                    else "a word is needed, or numbers such as 1,1.5,2"
                )
                message = f"{name}: '{text.quoted(value)}' is not valid: {needed}"
                raise ParameterError(message) from None


def list_words(form: Form, options: Any) -> list[str]:
    """Return the arguments of fishctl for a job."""
    words = [*form.words, *(list(_list_arguments(form, options)) or form.without_argument)]
    for name, value in getattr(options, "parameters", {}).items():
        words += [f"--{name.replace('_', '-')}", _format_value(value)]
    for field in form.fields:
        value = getattr(options, field.name)
        if value is None or value in (field.default, ""):
            continue
        words += [field.option] if value is True else [field.option, _format_value(value)]
    return [*words, "--take"] if getattr(options, "take", False) else words


def _list_arguments(form: Form, options: Any) -> Iterator[str]:
    value = getattr(options, form.argument) if form.argument else None
    yield from value if isinstance(value, list) else [value] if value else []
    if form.kind == "rerun" and options.controller:
        yield options.controller


def plan_without_verb(form: Form, options: Any) -> Plan | None:
    """Return the plan of a verb that has none itself; None if it ends when it is stopped."""
    field = next((field for field in form.fields if field.name == "seconds"), None)
    seconds: Any = field and (options.seconds or field.default)
    if not seconds:
        return None
    if form.argument == "name":
        return Plan(seconds, "s", seconds)
    return Plan(seconds, "s of virtual time")


def _format_value(value: Any) -> str:
    """Return a value in the notation of fishctl."""
    if isinstance(value, float):
        return f"{value:.15g}"
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()
