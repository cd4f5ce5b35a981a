"""What `fishctl --help` and its groups show, and what a misspelled verb gets."""

from collections.abc import Iterator

import click
import pytest
from click.testing import CliRunner

from fishd.cli.main import fishctl


def groups(command: click.Command, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    if isinstance(command, click.Group):
        yield path
        context = click.Context(command)
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            assert found
            yield from groups(found, (*path, name))


ALL = list(groups(fishctl))


@pytest.mark.parametrize("path", ALL, ids=lambda path: " ".join(("fishctl", *path)))
def test_no_summary_is_cut(path: tuple[str, ...]) -> None:
    shown = CliRunner().invoke(fishctl, [*path, "--help"], terminal_width=80)
    assert shown.exit_code == 0
    assert "..." not in shown.stdout.replace("[ARGS]...", "")


def test_verbs_stand_below_headings_that_say_what_one_wants() -> None:
    lines = CliRunner().invoke(fishctl, ["--help"]).stdout.splitlines()
    headings = [line for line in lines if line.endswith(":") and not line.startswith(" ")]
    assert headings == [
        "Options:", "Watch:", "Swim and stop:", "Experiment:", "Record:", "Camera:",
        "Calibrate:",
        "Simulate and learn:", "Check and configure:",
    ]  # fmt: skip
    assert "explain" not in "\n".join(lines)


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["setcontroller"], "set-controller"),
        (["learn", "exprt"], "export"),
        (["config", "chek"], "check"),
        (["calibrate", "forces"], "force"),
        (["status", "--jsn"], "--json"),
    ],
)
def test_a_misspelled_verb_gets_the_nearest(words: list[str], meant: str) -> None:
    done = CliRunner().invoke(fishctl, words)
    assert "Did you mean" in done.stderr
    assert f"'{meant}'" in done.stderr


def numbers(command: click.Command, name: str = "fishctl") -> Iterator[tuple[str, click.Parameter]]:
    """The options for a number within bounds, of all verbs."""
    if isinstance(command, click.Group):
        context = click.Context(command)
        for each in command.list_commands(context):
            found = command.get_command(context, each)
            assert found
            yield from numbers(found, f"{name} {each}")
    for parameter in command.params:
        if isinstance(parameter.type, click.FloatRange):
            yield name, parameter


def test_no_option_takes_for_a_number_within_bounds_what_is_none() -> None:
    found = list(numbers(fishctl))
    assert len(found) > 20
    for name, parameter in found:
        with pytest.raises(click.BadParameter, match="a finite number is needed"):
            print(name, parameter.name, parameter.type.convert("nan", parameter, None))


@pytest.mark.parametrize("verb", ["tare", "watch --json"])
def test_a_time_that_is_no_number_is_a_wrong_use(verb: str) -> None:
    done = CliRunner().invoke(fishctl, [*verb.split(), "--seconds", "nan"])
    assert done.exit_code == 2
    assert "'nan' is not valid: a finite number is needed" in done.stderr
