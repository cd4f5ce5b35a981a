"""Help of `fishctl` and its groups, and hints for misspelled verbs."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from fishd.cli import experiment_options
from fishd.cli.main import fishctl
from verb_reference import commands, options


def groups(command: click.Command, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    if isinstance(command, click.Group):
        yield path
        context = click.Context(command)
        for name in command.list_commands(context):
            subcommand = command.get_command(context, name)
            assert subcommand
            yield from groups(subcommand, (*path, name))


ALL_GROUPS = list(groups(fishctl))


@pytest.mark.parametrize("path", ALL_GROUPS, ids=lambda path: " ".join(("fishctl", *path)))
def test_no_summary_is_cut(path: tuple[str, ...]) -> None:
    shown = CliRunner().invoke(fishctl, [*path, "--help"], terminal_width=80)
    assert shown.exit_code == 0
    assert "..." not in shown.stdout.replace("[ARGS]...", "")


WITHOUT_EXTRAS = """
import sys
sys.modules |= dict.fromkeys(("aiohttp", "cv2", "numba", "onnx", "torch"))
from click.testing import CliRunner
from fishd.cli.main import fishctl
from verb_reference import commands
for words, _ in commands(fishctl):
    done = CliRunner().invoke(fishctl, [*words.split(), "--help"])
    assert done.exit_code == 0, (words, done.output, done.exception)
"""


@pytest.mark.slow
def test_the_help_of_every_verb_needs_the_extra_lab_at_most() -> None:
    folders = [str(folder) for folder in sys.path if folder]
    code = f"import sys; sys.path[:] = {folders!r}\n{WITHOUT_EXTRAS}"
    subprocess.run([sys.executable, "-P", "-c", code], check=True)


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


def numeric_options(
    command: click.Command, name: str = "fishctl"
) -> Iterator[tuple[str, click.Parameter]]:
    """Yield the options for a number within bounds, of all verbs."""
    if isinstance(command, click.Group):
        context = click.Context(command)
        for verb in command.list_commands(context):
            subcommand = command.get_command(context, verb)
            yield from numeric_options(subcommand, f"{name} {verb}")
    for parameter in command.params:
        if isinstance(parameter.type, click.FloatRange):
            yield name, parameter


def test_no_option_with_bounds_accepts_nan() -> None:
    bounded_options = list(numeric_options(fishctl))
    assert len(bounded_options) > 20
    for name, parameter in bounded_options:
        with pytest.raises(click.BadParameter, match="a finite number is needed"):
            print(name, parameter.name, parameter.type.convert("nan", parameter, None))


WITHOUT_JSON = {
    *("calibrate force", "calibrate servo", "camera page", "completion", "config example"),
    *("virtual-pi clear", "virtual-pi inject", "virtual-pi press", "virtual-pi run"),
    *("config schema", "virtual-pi release-button", "window", "window open", "window start"),
    "runs zip",
}
"""Verbs that print no result: dialogues, scripts, or nothing."""
METAVARS = {
    "--camera": {"ADDRESS", "[ADDRESS]"},
    "--camera-config": {"FILE"},
    "--plot": {"FILE"},
    "--record": {"FILE"},
    "--resume": {"FILE", "FOLDER"},
    "--to": {"FILE", "FOLDER", "FILE|FOLDER"},
}
"""What may follow an option, in any verb."""
EXPERIMENTS = ("measure", "compare", "sweep", "optimise", "identify", "adapt", "learn ppo")


def test_all_verbs_have_one_vocabulary() -> None:
    known = dict(commands(fishctl))
    without = {verb for verb, command in known.items() if "--json" not in options(command)}
    assert without == WITHOUT_JSON
    for verb, command in known.items():
        own_options = options(command)
        assert ("--for" in own_options) == ("--seconds" in own_options), verb
        assert not own_options & {"--tank-time", "--out", "--output", "--figure"}, verb
        for parameter in command.params:
            for name in METAVARS.keys() & set(parameter.opts):
                assert parameter.metavar in METAVARS[name], (verb, name)
            if "--seed" in parameter.opts:
                assert (parameter.help or "").startswith("Seed of the random number generator of")
            if "--on" in parameter.opts:
                assert list(parameter.type.choices) == ["live", "simulation"]
    for verb in EXPERIMENTS:
        shared = {"--on", "--config", "--endpoint", "--take", "--folder"}
        assert shared <= options(known[verb]), verb


@pytest.mark.parametrize("word", ["help", "list", "start", "run", "swim"])
def test_a_hint_for_a_word_of_other_programs_names_existing_verbs(word: str) -> None:
    done = CliRunner().invoke(fishctl, [word])
    assert done.exit_code == 2
    for verb in re.findall(r"'([a-z-]+)'", done.stderr.partition(": did you mean")[2]):
        assert verb in fishctl.list_commands(click.Context(fishctl)) or verb == "fishd"


def test_ten_verbs_are_marked_and_a_verb_of_controllers_shows_its_options() -> None:
    lines = CliRunner().invoke(fishctl, ["--help"]).stdout.splitlines()
    assert sum(" * " in line for line in lines) == 10
    shown = CliRunner().invoke(fishctl, ["measure", "--help"]).stdout
    assert all(option in shown for option in ("--for, --seconds", "--on", "--plot", "--json"))


@pytest.mark.parametrize(
    "words",
    [
        ("simulate", "square:frequency=1.7,amplitude=0.3"),
        ("simulate", "square", "--frequency", "1.7", "--amplitude", "0.3"),
        ("simulate", "square", "frequency=1.7", "amplitude=0.3"),
    ],
)
def test_parameters_stand_behind_a_controller_or_are_options(words: tuple[str, ...]) -> None:
    done = CliRunner().invoke(fishctl, [*words, "--for", "14", "--json"])
    assert json.loads(done.stdout)["parameters"] == {"frequency": 1.7, "amplitude": 0.3}


def test_the_fish_is_live_if_a_fishd_runs_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    choose = experiment_options.default_on
    monkeypatch.setattr(experiment_options, "is_fishd_running", lambda: True)
    assert choose(None, (), None) == "live"
    assert choose(Path("fish.yaml"), (), None) == "simulation"
    assert choose(None, ("plant.xi=1",), "ipc:///run/a") == "simulation"
    monkeypatch.setattr(experiment_options, "is_fishd_running", lambda: False)
    assert choose(None, (), None) == "simulation"
    assert choose(None, (), "ipc:///run/a") == "live"
