"""Options of the experiments of a page, and the command lines that a person would type for them.

A page gives no words of a command line, only values that are checked here.
"""

from collections.abc import Iterable, Iterator
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from fishd.core.schema import PRINTABLE

Name = Annotated[str, Meta(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*\Z", max_length=60)]
Word = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_.][A-Za-z0-9_.:,+=-]*\Z", max_length=200)]
RunName = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_. -]*\Z", max_length=100)]
Line = Annotated[str, Meta(pattern=PRINTABLE, max_length=200)]
Seconds = Annotated[float, Meta(gt=0, le=86400)]
QUEUE = "queue"
"""Kind of the job that runs the queue, whose experiments have their own folders."""
Value = bool | int | float | Word | None


class RecordOptions(Struct, forbid_unknown_fields=True):
    """Options of record."""

    name: RunName | None = None
    seconds: Seconds | None = None
    note: Line = ""
    subject: Line = ""
    operator: Line = ""


class MeasureOptions(Struct, forbid_unknown_fields=True):
    """Options of measure."""

    controller: Name
    parameters: dict[Name, Value] = {}
    seconds: Seconds = 60.0
    take: bool = False


class SweepOptions(Struct, forbid_unknown_fields=True):
    """Options of sweep; a parameter may have several values, such as `1,1.5,2` or `0.4:4:0.2`."""

    controller: Name
    parameters: dict[Name, Value] = {}
    seconds: Seconds = 30.0
    take: bool = False


class CompareOptions(Struct, forbid_unknown_fields=True):
    """Options of compare."""

    contestants: Annotated[list[Word], Meta(max_length=20)] = []
    seconds: Seconds = 60.0
    runs: Annotated[int, Meta(ge=1, le=100)] = 1
    take: bool = False


class SimulateOptions(Struct, forbid_unknown_fields=True):
    """Options of simulate."""

    controller: Name
    parameters: dict[Name, Value] = {}
    seconds: Annotated[float, Meta(ge=2, le=600)] = 20.0


class RerunOptions(Struct, forbid_unknown_fields=True):
    """Options of rerun."""

    run: RunName
    controller: Name | None = None
    parameters: dict[Name, Value] = {}


class QueueOptions(Struct, forbid_unknown_fields=True):
    """Options of the runner of the queue."""

    take: bool = False


class ResumeOptions(Struct, forbid_unknown_fields=True):
    """Options of resume: the folder of an experiment that is not complete."""

    run: RunName
    take: bool = False


KINDS: dict[str, type[Struct]] = {
    "record": RecordOptions,
    "measure": MeasureOptions,
    "sweep": SweepOptions,
    "compare": CompareOptions,
    "simulate": SimulateOptions,
    "rerun": RerunOptions,
    "resume": ResumeOptions,
    QUEUE: QueueOptions,
}
"""Options of each kind of job."""
MEASURED_KINDS = {"measure", "sweep", "compare"}
"""Kinds of jobs whose `seconds` must be enough for two swims between rests."""
DRIVING_KINDS = MEASURED_KINDS | {"resume", QUEUE}
"""Kinds of jobs that swim the fish."""


def list_words(kind: str, options: Any) -> list[str]:
    """Return the arguments of fishctl for a job of any kind but `resume`."""
    words = [kind, *_list_arguments(kind, options)]
    for name, value in _list_options(kind, options):
        words += [f"--{name}", _format_value(value)]
    if getattr(options, "take", False):
        words.append("--take")
    return words


def _list_arguments(kind: str, options: Any) -> Iterable[str]:
    if kind == "record":
        return [options.name] if options.name else []
    if kind == QUEUE:
        return ["start"]
    if kind == "compare":
        return list(options.contestants)
    if kind == "rerun":
        return [options.run, *filter(None, [options.controller])]
    return [options.controller]


def _list_options(kind: str, options: Any) -> Iterator[tuple[str, Any]]:
    """Yield name and value of each option that is not the default."""
    if kind == "record":
        for name in ("note", "subject", "operator"):
            if value := getattr(options, name):
                yield name, value
        if options.seconds:
            yield "for", options.seconds
    elif kind != QUEUE:
        for name, value in getattr(options, "parameters", {}).items():
            yield name.replace("_", "-"), value
        if kind == "compare" and options.runs > 1:
            yield "runs", options.runs
        if kind != "rerun":
            yield "for", options.seconds


def _format_value(value: Any) -> str:
    """Return a value in the notation of fishctl."""
    if isinstance(value, float):
        return f"{value:.15g}"
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()
