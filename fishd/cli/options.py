"""Options that verbs share, and options that are generated from the parameters of controllers."""

import math
import os
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

import click
from click.shell_completion import CompletionItem

from fishd.cli.completion import complete_value, endpoint_of
from fishd.cli.output import made_printable
from fishd.cli.plausibility import running_config, warn_of_values
from fishd.core import text
from fishd.core.errors import FishError, ParameterError, UnknownController
from fishd.core.schema import Field, names_file, spelled, wanted
from fishd.core.signals import ControllerInfo

if TYPE_CHECKING:
    from fishd.config import Config

F = TypeVar("F", bound=Callable[..., Any])

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


def _remember(ctx: click.Context, _: click.Parameter, value: str | None) -> str | None:
    return value or ctx.find_root().obj


endpoint_option = click.option(
    "--endpoint",
    metavar="ADDRESS",
    callback=_remember,
    help="Control socket of the daemon; default: $FISHD_ENDPOINT, else the one on this machine.",
)


_TAKE = "fishd.take"


def _remember_take(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    ctx.meta[_TAKE] = value


take_option = click.option(
    "--take",
    is_flag=True,
    expose_value=False,
    callback=_remember_take,
    help="Take the fish from another experiment that holds it; that one ends.",
)


class VerbLease(NamedTuple):
    """How the running verb takes the lease of a fish."""

    experiment: str
    """Name of the lease, such as `measure swing`."""
    take: bool


def verb_lease() -> VerbLease:
    """Return how the verb of this command line, which has `take_option`, takes the lease."""
    context = click.get_current_context()
    _, _, words = context.command_path.partition(" ")
    return VerbLease(words, bool(context.meta.get(_TAKE)))


def for_option(
    about: str, *, default: float | None = None, kind: click.ParamType[Any] | None = None
) -> Callable[[F], F]:
    """`--for`, a length in time; `--seconds` is another name for it."""
    return click.option(
        "--for",
        "--seconds",
        "seconds",
        type=kind or FiniteRange(min=0.0, min_open=True),
        metavar="SECONDS",
        default=default,
        show_default=default is not None,
        help=about,
    )


def plot_option(about: str) -> Callable[[F], F]:
    """`--plot`, a picture; about: what is in it."""
    return click.option(
        "--plot",
        "picture",
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="FILE",
        help=f"Draw {about} into this file (.png, .svg, .pdf).",
    )


def seed_option(what: str, default: int | None = 0) -> Callable[[F], F]:
    """`--seed`; what: what the random numbers are for."""
    return click.option(
        "--seed",
        type=click.IntRange(0, 2**32 - 1),
        default=default,
        show_default=default is not None,
        help=f"Seed of the random number generator of {what}.",
    )


def daemon_options(function: F) -> F:
    """`--endpoint` and `--json`."""
    return endpoint_option(json_option(function))


class FiniteRange(click.FloatRange):
    """A number within bounds, and neither `nan` nor `inf`, which click's own range lets through."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Text to number."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"'{value}' is not valid: a finite number is needed", param, ctx)
        return number


class Words(click.ParamType[str]):
    """Text for people, whatever encoding Python takes the command line for: it is UTF-8."""

    name = "text"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Bytes of the command line to text."""
        try:
            return value if value.isprintable() else os.fsencode(value).decode()
        except UnicodeError:
            self.fail(f"'{text.quoted(value)}' is not a text in UTF-8", param, ctx)


class ParameterType(click.ParamType[Any]):
    """A value for one parameter of a controller; whether it is in range the daemon decides."""

    def __init__(self, field: Field) -> None:
        self.field = field
        self.name = field.kind

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Text from the command line to number, boolean or text."""
        field = self.field
        if value is None or not isinstance(value, str):
            return value
        if field.optional and value.lower() in ("null", "none", "default"):
            return None
        if value in field.words:
            return value
        if field.file and names_file(value, field.file):
            from fishd.core import files

            return str(files.expanded(value).absolute())  # fishd may run in another folder
        try:
            return _PARSERS.get(field.kind, str)(value)
        except ValueError:
            self.fail(f"'{value}' is not valid: {wanted(field)} is needed", param, ctx)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """What there is to choose from."""
        return complete_value(self.field, incomplete)


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(text)
    return number


def _boolean(text: str) -> bool:
    words = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
    if text.lower() not in words:
        raise ValueError(text)
    return words[text.lower()]


_PARSERS: dict[str, Callable[[str], Any]] = {"number": _finite, "integer": int, "boolean": _boolean}

_PREFIX = "parameter_"


class ValuesType(ParameterType):
    """Several values for one parameter: a list, or a range of numbers."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """`0.4:4:0.2` or `0.3,0.6` from the command line to a list of values."""
        if not isinstance(value, str):
            return value
        from fishd.lab.sweep.grid import expand_values

        try:
            return [
                super(ValuesType, self).convert(each, param, ctx) for each in expand_values(value)
            ]
        except ParameterError as error:
            self.fail(str(error), param, ctx)


def parameter_options(
    fields: Iterable[Field], kind: type[ParameterType] = ParameterType
) -> list[click.Parameter]:
    """One option for each parameter of a controller, its case kept (`--C`)."""
    several = "|LOW:HIGH:STEP|VALUE,..." if kind is ValuesType else ""
    return [
        click.Option(
            [_PREFIX + field.name, "--" + field.name.replace("_", "-")],
            type=kind(field),
            metavar=("NAME|FILE" if field.file else field.kind.upper()) + several,
            help=describe(field),
            default=None,
        )
        for field in fields
    ]


def given_parameters(context: click.Context, values: dict[str, Any]) -> dict[str, Any]:
    """Take the parameters out of a command's values; keep those from the command line."""
    taken = {name: values.pop(name) for name in list(values) if name.startswith(_PREFIX)}
    return {
        name.removeprefix(_PREFIX): value
        for name, value in taken.items()
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE
    }


def describe(field: Field) -> str:
    """Description, permitted values, unit and default of a parameter in one line."""
    permitted = wanted(field)
    default = "required" if field.required else f"default {spelled(field.default)}"
    return f"{field.description} {permitted[0].upper()}{permitted[1:]}; {default}."


def _fish_of(values: dict[str, Any]) -> "Config | None":
    """Return the configuration of the fish that the options of a verb are about.

    None where its forces are not in newtons. Raises `FishdError`.
    """
    from fishd.config import load

    chosen = values.get("fish")
    if chosen.on == "live" if chosen else "endpoint" in values:
        from fishd.client import Fish  # with zmq, which simulations do without

        with Fish(chosen.endpoint if chosen else values["endpoint"]) as fish:
            return running_config(fish)
    return chosen.load() if chosen else load(values.get("file"), values.get("overrides", ()))


class _ControllerCommand(click.Command):
    """Takes a parameter as `NAME=VALUE`, too."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """A word that begins as a name and `=` is an option whose dashes were left out."""
        options = (param for param in self.params if isinstance(param, click.Option))
        take_value = {name for option in options if not option.is_flag for name in option.opts}
        words = []
        for before, word in zip(["", *args], args, strict=False):
            name, equals, value = word.partition("=")
            if equals and name.isidentifier() and before not in take_value:
                word = f"--{name.replace('_', '-')}={value}"
            words.append(word)
        return super().parse_args(ctx, words)


class ControllerGroup(click.Group):
    """A verb whose sub-commands are the controllers, each with its parameters as options.

    Controllers that are installed here are known without a daemon. For any other name a verb that
    is `remote` asks the daemon, which may run on a machine where more is installed.
    """

    def __init__(
        self,
        *args: Any,
        options: Callable[[F], F],
        remote: bool = False,
        several: bool = False,
        resumable: bool = False,
        **kwargs: Any,
    ) -> None:
        """
        resumable: the verb has `--resume`
        options: decorator that adds the verb's own options to each sub-command
        several: `square,sine` is a sub-command, too; each parameter takes several values
        """
        super().__init__(*args, **kwargs)
        self.options_metavar = ""
        self.subcommand_metavar = "CONTROLLER [OPTIONS]"
        self._options = options
        self._resumable = resumable
        self._remote = remote
        self._several = several
        self._action: Callable[..., Any] = lambda: None

    def action(self, function: F) -> F:
        """Decorator: call `function(name, parameters, **options)` for each sub-command.

        With several, it gets their `ControllerInfo`s for the name, and lists of values.
        """
        self._action = function
        return function

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read `square:frequency=1.7,amplitude=0.3`, and what `--resume` begins with."""
        if self._resumable:
            from fishd.cli.experiment_options import recall

            args = recall(ctx, args)
        if args and ":" in args[0] and not args[0].startswith("-"):
            from fishd.controllers import registry

            try:
                name, pairs = registry.split_spec(args[0])
            except ParameterError as error:
                raise click.UsageError(str(error), ctx) from None
            options = [f"--{key.replace('_', '-')}={value}" for key, value in pairs]
            args = [name, *options, *args[1:]]
        return super().parse_args(ctx, args)

    def list_commands(self, ctx: click.Context) -> list[str]:
        """The controllers installed here."""
        from fishd.controllers import registry

        return [info.name for info in registry.describe_all()]

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete the name of a controller, and import only those that it may be."""
        from fishd.controllers import registry

        known = registry.describe_all(incomplete)
        names = [CompletionItem(info.name, help=info.summary) for info in known]
        return names + click.Command.shell_complete(self, ctx, incomplete)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """The sub-command of one controller, or of several."""
        names = list(filter(None, cmd_name.split(","))) if self._several else [cmd_name]
        infos = [self._info(ctx, name) for name in names]
        fields = {field.name: field for info in infos for field in info.parameters}

        @click.pass_context
        def callback(ctx: click.Context, /, **values: Any) -> Any:
            parameters = given_parameters(ctx, values)
            warn_of_values(fields.values(), parameters, partial(_fish_of, values))
            return self._action(infos if self._several else cmd_name, parameters, **values)

        decorated = self._options(cast(Any, callback))
        about = infos[0].summary if len(infos) == 1 else f"{', '.join(names)}, side by side."
        command = click.command(cmd_name, _ControllerCommand, help=about, short_help=about)(
            decorated
        )
        kind = ValuesType if self._several else ParameterType
        command.params = parameter_options(fields.values(), kind) + command.params
        return command

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the options of the verb itself, which go after the controller, and the controllers.

        'fishctl VERB CONTROLLER --help' has them with the parameters of that controller.
        """
        own = self._options(cast(Any, lambda: None))
        params = reversed(getattr(own, "__click_params__", []))
        records = [record for param in params if (record := param.get_help_record(ctx))]
        with formatter.section("Options"):
            formatter.write_dl([*records, ("-h, --help", "Show this message and exit.")])
        self.format_commands(ctx, formatter)

    def _info(self, ctx: click.Context, name: str) -> ControllerInfo:
        from fishd.controllers import registry

        try:
            return registry.describe(name)
        except UnknownController as error:
            if not self._remote:
                raise
            return self._ask_daemon(ctx, name, error)

    def _ask_daemon(
        self, ctx: click.Context, name: str, unknown: UnknownController
    ) -> ControllerInfo:
        from fishd.client import Fish

        try:
            with Fish(endpoint_of(ctx)) as fish:
                known = {info.name: info for info in map(made_printable, fish.controllers())}
        except FishError:
            raise unknown from None
        if name not in known:
            raise unknown
        return known[name]
