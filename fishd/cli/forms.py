"""Descriptions of experiments as forms of a page, made from the verbs of the command line."""

from collections.abc import Sequence
from typing import Any

import click
from msgspec import Struct

from fishd.cli.controller_arguments import ControllerGroup, ValuesType
from fishd.cli.experiment_options import RUN_ONLY_OPTIONS, FishOption
from fishd.cli.optimise import RangeType
from fishd.cli.options import NamesType, Utf8Text
from fishd.cli.verbs import missing_package
from fishd.core.experiments import Form, FormField


class _Source(Struct, frozen=True):
    """Verb of a form, and what a page does in another way than the command line."""

    title: str
    words: str = ""
    """Words of the verb; empty for the kind itself."""
    argument: Any = "controller"
    main: tuple[str, ...] = ("seconds",)
    """Names of the fields that are always shown."""
    initial: dict[str, Any] = {}
    """Values with which the form begins."""
    bounds: dict[str, tuple[float, float]] = {}
    without_argument: tuple[str, ...] = ()
    """Options that the verb needs if no argument is given."""
    packages: tuple[str, ...] = ("pandas",)
    """Packages without which the verb fails."""


_SOURCES = {
    "measure": _Source("Measure"),
    "sweep": _Source("Sweep"),
    "compare": _Source("Compare", argument="contestants", main=("runs", "seconds")),
    "optimise": _Source("Optimise", main=("budget",), packages=("bayes_opt",)),
    "identify": _Source(
        "Identify", "", "recordings", without_argument=("--experiment",), packages=("scipy",)
    ),
    "adapt": _Source(
        "Adapt", "", "", ("budget",), {"no_command": True},
        packages=("bayes_opt", "onnxruntime", "tensorboard", "torch"),
    ),
    "learn": _Source(
        "Learn", "learn ppo", "", ("steps",), {"on": "simulation"},
        packages=("stable_baselines3", "tensorboard", "torch"),
    ),
    "record": _Source("Record", "", "name", ("seconds", "subject", "note"), packages=("mcap",)),
    "simulate": _Source("Try first", bounds={"seconds": (2.0, 600.0)}, packages=("mcap",)),
    "rerun": _Source("Rerun", argument="run", packages=("pandas",)),
}  # fmt: skip
"""Verb of each form, in the order of a page."""
_ON_HELP = "live: the fish of this page; simulation: a simulated fish in virtual time."
_LEFT_OUT = {*RUN_ONLY_OPTIONS, "--force", "--jobs", "--seeds", "--black-box"} - {"--on"}
"""Options that no page gives: where results go, which fishd, how many processes."""


def describe_forms() -> list[Form]:
    """Return the forms of all verbs that a page may run."""
    from fishd.cli.main import fishctl

    return [_describe(fishctl, kind, source) for kind, source in _SOURCES.items()]


def _describe(root: click.Group, kind: str, source: _Source) -> Form:
    words = (source.words or kind).split()
    context = click.Context(root)
    command: click.Command | None = root
    for word in words:
        assert isinstance(command, click.Group)
        command = command.get_command(context, word)
    assert command
    values: Any = ""
    params: Sequence[click.Parameter] = command.params
    if isinstance(command, ControllerGroup):
        params, values = command.own_params(), _VALUES.get(command.kind, "one")
    names = {param.opts[0] for param in params}
    fields = [
        field
        for param in params
        if isinstance(param, click.Option)
        and param.opts[0] not in source.without_argument
        and (field := _describe_option(param, source))
    ]
    return Form(
        kind,
        source.title,
        words,
        (command.help or "").partition("\n\n")[0].replace("\n", " "),
        argument=source.argument,
        without_argument=list(source.without_argument),
        values=values,
        fields=fields,
        is_experiment="--on" in names,
        has_plan="--dry-run" in names,
        problem=next(filter(None, map(missing_package, source.packages)), ""),
    )


_VALUES = {RangeType: "range", ValuesType: "several"}


def _describe_option(option: click.Option, source: _Source) -> FormField | None:
    """Return an option as a field; None if no page gives it."""
    name, kind = option.name or "", option.type
    if option.opts[0] in _LEFT_OUT or option.multiple:
        return None
    units = {"SECONDS": "s", "MN": "mN"}
    default = option.default if isinstance(option.default, bool | int | float | str) else None
    more: dict[str, Any] = {}
    if name == "on":
        described, default = "choice", "live"
        more = {"choices": ("live", "simulation"), "description": _ON_HELP}
    elif option.is_flag:
        described, default = "boolean", False
    elif isinstance(kind, click.Choice):
        described, more = "choice", {"choices": tuple(kind.choices), "optional": default is None}
    elif isinstance(kind, click.types.IntParamType | click.types.FloatParamType):
        described = "integer" if isinstance(kind, click.types.IntParamType) else "number"
        if isinstance(kind, click.types._NumberRangeBase):
            more = {
                "low": kind.min, "high": kind.max,
                "low_open": kind.min_open, "high_open": kind.max_open,
            }  # fmt: skip
    elif isinstance(kind, Utf8Text | NamesType):
        described, default = "text", default or ""
    else:
        return None
    if bounds := source.bounds.get(name):
        more = {"low": bounds[0], "high": bounds[1]}
    return FormField(
        **{
            "name": name, "kind": described, "unit": units.get(option.metavar or "", ""),
            "description": option.help or "",
            "default": default, "optional": False, "option": option.opts[0],
            "on": option.on if isinstance(option, FishOption) else "",
            "main": name in ("on", *source.main), "initial": source.initial.get(name), **more,
        }
    )  # fmt: skip
