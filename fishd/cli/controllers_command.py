"""Verbs of which several arguments are controllers, as `square --frequency 1.7 swing --C 0.6`."""

from collections.abc import Sequence

import click

from fishd.controllers import registry


class ControllersCommand(click.Command):
    """Verb of which some arguments are controllers, each with parameters as options after it."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments after writing `CONTROLLER --key value` as `CONTROLLER:key=value`."""
        return super().parse_args(ctx, join_parameters(self, args))


def join_parameters(command: click.Command, args: Sequence[str]) -> list[str]:
    """Return arguments in which each `CONTROLLER --key value` is `CONTROLLER:key=value`."""
    options = {name: param for param in command.params for name in param.opts}
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
        words.append(word)
        option = options.get(name)
        if isinstance(option, click.Option) and not (option.is_flag or equals):
            words += [value for value in [next(remaining, None)] if value is not None]
    return words
