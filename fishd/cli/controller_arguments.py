"""Arguments that are controllers: `NAME:key=value,…` is `NAME --key value`, in every verb.

The options are generated from the parameters of the controllers.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, cast

import click
from click.shell_completion import CompletionItem

from fishd.cli.completion import complete_value, endpoint_of
from fishd.cli.output import make_printable
from fishd.cli.plausibility import running_config, warn_of_values
from fishd.core.errors import FishError, ParameterError, UnknownController
from fishd.core.schema import (
    Field,
    describe_permitted,
    format_literal,
    names_file,
    parse_value,
)
from fishd.core.signals import ControllerInfo

if TYPE_CHECKING:
    from fishd.config import Config

F = TypeVar("F", bound=Callable[..., Any])


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

    run = values.get("run")
    chosen_fish = run.fish if run else None
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
        names = [word.partition("=")[0] for word in words]
        own = self._parameter_options()
        twice = [name for name in own if names.count(name) > 1]
        if twice and "--resume" not in names:  # what is given besides replaces what was kept
            raise click.UsageError(f"{twice[0].removeprefix('--')} is given twice", ctx)
        try:
            return super().parse_args(ctx, words)
        except click.NoSuchOption as error:
            raise _no_such_option(error.option_name, ctx, own) from None

    def _parameter_options(self) -> list[str]:
        """Return the options of the controller's parameters."""
        return [p.opts[0] for p in self.params if (p.name or "").startswith(_PREFIX)]


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
        self.kind, self._several = kind, kind is ValuesType
        self._action: Callable[..., Any] = lambda: None

    def action(self, function: F) -> F:
        """Decorator: call `function(name, parameters, **options)` for each sub-command.

        With `ValuesType`, `name` is a list of `ControllerInfo`s, each parameter a list of values.
        """
        self._action = function
        return function

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse `square:frequency=1.7,amplitude=0.3`, the name of a policy, and any order."""
        places = list(self._find_words(ctx, args))
        if places:
            self._refuse_several(ctx, [args[place] for place in places])
            first = places[0]
            args = [*self._split(ctx, args[first]), *args[:first], *args[first + 1 :]]
        elif args and not set(args) & set(ctx.help_option_names):
            raise click.UsageError(f"a controller is needed, as in: {ctx.command_path} swing", ctx)
        return super().parse_args(ctx, args)

    def _find_words(self, ctx: click.Context, args: list[str]) -> Iterator[int]:
        """Yield the places of the arguments that are neither options nor their values."""
        params = self.own_params()
        flags = {*ctx.help_option_names, *(n for p in params if p.is_flag for n in p.opts)}
        is_value = False
        for place, word in enumerate(args):
            if not word.startswith("-") and not is_value:
                yield place
            takes_value = word.startswith("-") and "=" not in word and word not in flags
            is_value = takes_value and not is_value

    def _refuse_several(self, ctx: click.Context, words: list[str]) -> None:
        """Raise `UsageError` if a verb that takes `square,sine` has these as two words."""
        from fishd.controllers import registry

        names = [word.partition(":")[0] for word in words]
        if self._several and names[1:] and set(names[1:]) <= set(registry.names()):
            message = f"several controllers with one grid are one word: {','.join(names)}"
            raise click.UsageError(message, ctx)

    def _split(self, ctx: click.Context, word: str) -> list[str]:
        """Return a controller and its parameters as options."""
        from fishd.controllers import registry

        name = word.partition(":")[0]
        if name not in registry.names():
            from fishd.controllers.policy import library

            if word in library.names() or names_file(word, library.SUFFIX):
                return ["ppo", f"--policy={word}"]
        try:
            name, pairs = registry.split_spec(word)
        except ParameterError as error:
            raise click.UsageError(str(error), ctx) from None
        return [name, *(f"--{key.replace('_', '-')}={value}" for key, value in pairs)]

    def own_params(self) -> list[click.Option]:
        """Return the options of the verb itself, in the order of its help."""
        decorated = self._options(cast(Any, lambda: None))
        return list(reversed(getattr(decorated, "__click_params__", [])))

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
        command.params = parameter_options(fields.values(), self.kind) + command.params
        return command

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the options of the verb itself, and the controllers.

        'fishctl VERB CONTROLLER --help' lists them with the parameters of that controller.
        """
        from fishd.controllers import registry

        params = self.own_params()
        records = [record for param in params if (record := param.get_help_record(ctx))]
        with formatter.section("Options"):
            formatter.write_dl([*records, ("-h, --help", "Show this message and exit.")])
        with formatter.section("Controllers, such as square --frequency 1.7, square:frequency=1.7"):
            formatter.write_dl([(info.name, info.summary) for info in registry.describe_all()])

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


def _no_such_option(name: str, ctx: click.Context, parameters: Sequence[str]) -> click.UsageError:
    """Return the error for an option that there is not, with similar ones or the parameters."""
    options = [name for param in ctx.command.params for name in param.opts]
    error = click.NoSuchOption(name, possibilities=[*options, *parameters], ctx=ctx)
    if error.possibilities or not parameters:
        return error
    return click.UsageError(
        f"No such option '{name}'; the parameters are {', '.join(parameters)}", ctx
    )


class ControllersCommand(click.Command):
    """Verb of which some arguments are controllers, each with parameters as options after it."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments after writing `CONTROLLER --key value` as `CONTROLLER:key=value`."""
        return super().parse_args(ctx, join_parameters(ctx, args))


def join_parameters(ctx: click.Context, args: Sequence[str]) -> list[str]:
    """Return arguments in which each `CONTROLLER --key value` is `CONTROLLER:key=value`.

    Raises `NoSuchOption` for an option that neither the verb nor the controller has.
    """
    from fishd.controllers import registry

    options = {name: param for param in ctx.command.params for name in param.opts}
    words: list[str] = []
    controller, keys = 0, set[str]()  # place among `words`, and names of its parameters
    remaining = iter(args)
    for word in remaining:
        name, equals, value = word.partition("=")
        key = name.removeprefix("--").replace("-", "_")
        if not word.startswith("-"):
            controller, keys = len(words), registry.parameter_names(word.partition(":")[0])
        elif name not in options and key in keys:
            value = value if equals else next(remaining, "")
            words[controller] += f"{',' if ':' in words[controller] else ':'}{key}={value}"
            continue
        elif name not in options and keys and name not in ("-h", "--help"):
            ours = ["--" + key.replace("_", "-") for key in sorted(keys)]
            raise _no_such_option(name, ctx, ours)
        words.append(word)
        option = options.get(name)
        if isinstance(option, click.Option) and not (option.is_flag or equals):
            words += [value for value in [next(remaining, None)] if value is not None]
    return words
