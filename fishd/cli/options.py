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
from fishd.cli.output import make_printable
from fishd.cli.plausibility import running_config, warn_of_values
from fishd.core import text
from fishd.core.errors import FishError, ParameterError, UnknownController
from fishd.core.schema import Field, describe_permitted, format_literal, names_file, parse_value
from fishd.core.signals import ControllerInfo

if TYPE_CHECKING:
    from fishd.config import Config

F = TypeVar("F", bound=Callable[..., Any])

json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON.")


def _choose_endpoint(ctx: click.Context, _: click.Parameter, value: str | None) -> str | None:
    return value or ctx.find_root().obj


endpoint_option = click.option(
    "--endpoint",
    metavar="ADDRESS",
    callback=_choose_endpoint,
    help="Control socket of the daemon; default: $FISHD_ENDPOINT, else the one on this machine.",
)

_TAKE = "fishd.take"


def _store_take(ctx: click.Context, _: click.Parameter, value: bool) -> None:
    ctx.meta[_TAKE] = value


take_option = click.option(
    "--take",
    is_flag=True,
    expose_value=False,
    callback=_store_take,
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
    """Return the option `--for`, a duration; `--seconds` is another name for it."""
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
    """Return the option `--plot`, the file of a picture; about: what the picture shows."""
    return click.option(
        "--plot",
        "picture",
        type=click.Path(path_type=Path, dir_okay=False),
        metavar="FILE",
        help=f"Draw {about} into this file (.png, .svg, .pdf).",
    )


def seed_option(what: str, default: int | None = 0) -> Callable[[F], F]:
    """Return the option `--seed`; what: what the random numbers are for."""
    return click.option(
        "--seed",
        type=click.IntRange(0, 2**32 - 1),
        default=default,
        show_default=default is not None,
        help=f"Seed of the random number generator of {what}.",
    )


def camera_config_option(scope: str = "") -> Callable[[F], F]:
    """Return the option `--camera-config`; scope: when it can be given."""
    return click.option(
        "--camera-config",
        metavar="FILE",
        help=f"{scope}YAML file of a simulated camera, such as config/camera-web.yaml. [default: a "
        "good camera]",
    )


def daemon_options(function: F) -> F:
    """Add `--endpoint` and `--json`."""
    return endpoint_option(json_option(function))


class FiniteRange(click.FloatRange):
    """Finite number within bounds; click's own range also accepts `nan` and `inf`."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Convert a text to a number."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"'{value}' is not valid: a finite number is needed", param, ctx)
        return number


class Utf8Text(click.ParamType[str]):
    """Text in UTF-8, whatever encoding Python assumes for the command line."""

    name = "text"

    def convert(self, value: str, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Convert the bytes of the command line to text."""
        try:
            return value if value.isprintable() else os.fsencode(value).decode()
        except UnicodeError:
            self.fail(f"'{text.quoted(value)}' is not a text in UTF-8", param, ctx)


class ParameterType(click.ParamType[Any]):
    """Value of one parameter of a controller; the daemon checks whether it is in range."""

    metavar = ""
    """Notation of several values, in help texts."""

    def __init__(self, field: Field) -> None:
        self.field = field
        self.name = field.kind

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert a text of the command line to a number, boolean or text."""
        field = self.field
        if not isinstance(value, str):
            return value
        if field.file and names_file(value, field.file):
            from fishd.core import files

            return str(files.expand_user(value).absolute())  # fishd may run in another folder
        try:
            return parse_value(field, value)
        except ValueError as error:
            self.fail(str(error), param, ctx)

    def shell_complete(
        self, ctx: click.Context, param: click.Parameter, incomplete: str
    ) -> list[CompletionItem]:
        """Return the values that complete a text."""
        return complete_value(self.field, incomplete)


_PREFIX = "parameter_"


class ValuesType(ParameterType):
    """List of values of one parameter: spelled as a list, or as a range of numbers."""

    metavar = "|LOW:HIGH:STEP|VALUE,..."

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Convert `0.4:4:0.2` or `0.3,0.6` to a list of values."""
        if not isinstance(value, str):
            return value
        from fishd.lab.sweep.grid import expand_values

        try:
            return [
                super(ValuesType, self).convert(item, param, ctx) for item in expand_values(value)
            ]
        except ParameterError as error:
            self.fail(str(error), param, ctx)


def parameter_options(
    fields: Iterable[Field], kind: type[ParameterType] = ParameterType
) -> list[click.Parameter]:
    """Return an option for each parameter of a controller, with its upper case (`--C`)."""
    return [
        click.Option(
            [_PREFIX + field.name, "--" + field.name.replace("_", "-")],
            type=kind(field),
            metavar=("NAME|FILE" if field.file else field.kind.upper()) + kind.metavar,
            help=describe_parameter(field),
            default=None,
        )
        for field in fields
    ]


def given_parameters(context: click.Context, values: dict[str, Any]) -> dict[str, Any]:
    """Take the parameters out of a command's values; keep those from the command line."""
    all_parameters = {name: values.pop(name) for name in list(values) if name.startswith(_PREFIX)}
    return {
        name.removeprefix(_PREFIX): value
        for name, value in all_parameters.items()
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE
    }


def describe_parameter(field: Field) -> str:
    """Return description, permitted values, unit and default of a parameter in one line."""
    permitted = describe_permitted(field)
    default = "required" if field.required else f"default {format_literal(field.default)}"
    return f"{field.description} {permitted[0].upper()}{permitted[1:]}; {default}."


def _read_fish_config(values: dict[str, Any]) -> "Config | None":
    """Return the configuration of the fish that the options of a verb are about.

    None if its forces are not in newtons. Raises `FishdError`.
    """
    from fishd.config import load

    chosen_fish = values.get("fish")
    if chosen_fish.on == "live" if chosen_fish else "endpoint" in values:
        from fishd.client import Fish  # imports zmq, which simulations do not need

        with Fish(chosen_fish.endpoint if chosen_fish else values["endpoint"]) as fish:
            return running_config(fish)
    return (
        chosen_fish.load() if chosen_fish else load(values.get("file"), values.get("overrides", ()))
    )


class _ControllerCommand(click.Command):
    """Command that also takes parameters as `NAME=VALUE`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse arguments, where `NAME=VALUE` is an option whose dashes were left out."""
        options = (param for param in self.params if isinstance(param, click.Option))
        take_value = {name for option in options if not option.is_flag for name in option.opts}
        words = []
        for previous, word in zip(["", *args], args, strict=False):
            name, equals, value = word.partition("=")
            if equals and name.isidentifier() and previous not in take_value:
                word = f"--{name.replace('_', '-')}={value}"
            words.append(word)
        return super().parse_args(ctx, words)


class ControllerGroup(click.Group):
    """Verb whose sub-commands are the controllers, each with its parameters as options.

    Controllers that are installed here are known without a daemon. For any other name, a `remote`
    verb asks the daemon, which may run on a machine where more controllers are installed.
    """

    def __init__(
        self,
        *args: Any,
        options: Callable[[F], F],
        remote: bool = False,
        kind: type[ParameterType] = ParameterType,
        **kwargs: Any,
    ) -> None:
        """
        options: decorator that adds the verb's own options to each sub-command
        kind: type of the parameters; with `ValuesType`, `square,sine` is a sub-command, too
        """
        super().__init__(*args, **kwargs)
        self.options_metavar = ""
        self.subcommand_metavar = "CONTROLLER [OPTIONS]"
        self._options = options
        self._remote = remote
        self._kind, self._several = kind, kind is ValuesType
        self._action: Callable[..., Any] = lambda: None

    def action(self, function: F) -> F:
        """Decorator: call `function(name, parameters, **options)` for each sub-command.

        With `ValuesType`, `name` is a list of `ControllerInfo`s, each parameter a list of values.
        """
        self._action = function
        return function

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse `square:frequency=1.7,amplitude=0.3`."""
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
        """Return the names of the controllers that are installed here."""
        from fishd.controllers import registry

        return [info.name for info in registry.describe_all()]

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete the name of a controller, and import only the matching controllers."""
        from fishd.controllers import registry

        controllers = registry.describe_all(incomplete)
        names = [CompletionItem(info.name, help=info.summary) for info in controllers]
        return names + click.Command.shell_complete(self, ctx, incomplete)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Return the sub-command of one controller, or of several."""
        names = list(filter(None, cmd_name.split(","))) if self._several else [cmd_name]
        infos = [self._find_controller(ctx, name) for name in names]
        fields = {field.name: field for info in infos for field in info.parameters}

        @click.pass_context
        def callback(ctx: click.Context, /, **values: Any) -> Any:
            parameters = given_parameters(ctx, values)
            warn_of_values(fields.values(), parameters, partial(_read_fish_config, values))
            return self._action(infos if self._several else cmd_name, parameters, **values)

        decorated = self._options(cast(Any, callback))
        summary = infos[0].summary if len(infos) == 1 else f"{', '.join(names)}, side by side."
        command = click.command(cmd_name, _ControllerCommand, help=summary, short_help=summary)(
            decorated
        )
        command.params = parameter_options(fields.values(), self._kind) + command.params
        return command

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the options of the verb itself, which go after the controller, and the controllers.

        'fishctl VERB CONTROLLER --help' lists them with the parameters of that controller.
        """
        decorated = self._options(cast(Any, lambda: None))
        params = reversed(getattr(decorated, "__click_params__", []))
        records = [record for param in params if (record := param.get_help_record(ctx))]
        with formatter.section("Options"):
            formatter.write_dl([*records, ("-h, --help", "Show this message and exit.")])
        self.format_commands(ctx, formatter)

    def _find_controller(self, ctx: click.Context, name: str) -> ControllerInfo:
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
                controllers = {info.name: info for info in map(make_printable, fish.controllers())}
        except FishError:
            raise unknown from None
        if name not in controllers:
            raise unknown
        return controllers[name]
