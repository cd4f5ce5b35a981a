"""One grammar of controllers: `NAME:key=value,…` and `NAME --key value` are the same everywhere."""

import json
from pathlib import Path

import click
import pytest
from click.testing import CliRunner
from rigs.processes import fishctl, one_line

from fishd.cli.controller_arguments import ControllersCommand
from fishd.controllers import registry
from fishd.core.errors import ParameterError
from fishd.lab.compare.contestants import parse, parse_all


@click.command(cls=ControllersCommand)
@click.argument("words", nargs=-1)
@click.option("--for", "seconds", type=float)
@click.option("--json", is_flag=True)
def verb(words: tuple[str, ...], seconds: float | None, json: bool) -> None:
    """Print the arguments."""
    click.echo(f"{' '.join(words)} {seconds} {json}")


@pytest.mark.parametrize(
    ("line", "output"),
    [
        ("swing --C 0.6", "swing:C=0.6 None False"),
        ("swing --C=0.6 --for 20 --lead 0.1", "swing:C=0.6,lead=0.1 20.0 False"),
        ("--for 20 swing --C -1 square", "swing:C=-1 square 20.0 False"),
        ("swing:C=0.6 --json --lead 0 file.onnx", "swing:C=0.6,lead=0 file.onnx None True"),
        ("square --frequency 1,1.7 sine --frequency 2", "square:frequency=1,1.7 sine:frequency=2"),
    ],
)
def test_parameters_may_be_options_after_their_controller(line: str, output: str) -> None:
    assert CliRunner().invoke(verb, line.split()).output.startswith(output)


@pytest.mark.parametrize(
    ("line", "remedy"),
    [
        ("--C 0.6 swing", ""),
        ("latest --C 0.6", ""),
        ("swing --frequency 2", "the parameters are --C,"),
        ("swing --c 0.4", "Did you mean '--C'"),
    ],
)
def test_an_option_of_no_controller_before_it_is_refused(line: str, remedy: str) -> None:
    output = CliRunner().invoke(verb, line.split()).output
    assert "No such option" in output
    assert remedy in output


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("measure --on simulation", "a controller is needed, as in: fishctl measure swing"),
        ("simulate square:frequency=1.2 --frequency 1.4", "frequency is given twice"),
        ("simulate square --frequency 1.2 --frequency=1.4", "frequency is given twice"),
        ("compare swing:C=0.6 --C 0.4", "swing:C=0.6,C=0.4: C is given twice"),
        ("sweep square --vary plant.xi=1 --vary plant.xi=2", "plant.xi is given twice"),
        ("sweep square --vary plant.xi=", "write KEY=VALUES"),
        ("sweep square sine", "several controllers with one grid are one word: square,sine"),
        ("simulate sine --C 0.4", "the parameters are --frequency, --amplitude"),
        ("compare square --frequency 1:2", "frequency: '1:2' is not valid: LOW:HIGH:STEP"),
        ("optimise square --frequency 1,2", "LOW:HIGH is needed, such as 0.5:4"),
        ("simulate square --frequency 1_0", "'1_0' is not valid: a number"),
        ("simulate square --frequency 1e-320", "a number in [0.001, 10] Hz is needed"),
    ],
)
def test_a_wrong_controller_is_one_line_that_says_what_is_right(line: str, message: str) -> None:
    assert message in one_line(fishctl(*line.split()))


def test_a_folder_may_be_named_like_a_controller(tmp_path: Path) -> None:
    words = ("square", "--frequency", "1.2", "--periods", "2", "--settle", "0")
    done = fishctl("sweep", *words, "--folder", str(tmp_path / "run"), "--on", "simulation")
    assert done.returncode == 0
    refused = fishctl("sweep", "--resume", "sine", "--jobs", "1")
    assert "sine: no experiment to resume: there is no such folder" in one_line(refused)
    refused = fishctl("sweep", "square", "--folder", "sine", "--periods", "1")
    assert "1 is not in the range" in one_line(refused)


def test_options_may_stand_before_the_controller_and_a_policy_is_one() -> None:
    swims = [
        json.loads(fishctl("simulate", *words, "--json", "--for", "12").stdout)
        for words in (("--settle", "2", "ppo", "--policy", "default-fish"), ("default-fish",))
    ]
    assert {swim["controller"] for swim in swims} == {"ppo"}
    assert swims[0]["parameters"] == swims[1]["parameters"]


def test_a_list_and_a_range_are_several_contestants() -> None:
    labels = [contestant.label for contestant in parse_all(["square:frequency=1,1.5", "swing"])]
    assert labels == ["square:frequency=1", "square:frequency=1.5", "swing"]
    several = parse_all(["sine:frequency=1:2:0.5,amplitude=0.3,0.4"])
    assert [tuple(contestant.parameters.values()) for contestant in several] == [
        (frequency, amplitude) for frequency in (1.0, 1.5, 2.0) for amplitude in (0.3, 0.4)
    ]


def test_a_value_has_the_same_words_for_compare_as_for_other_verbs() -> None:
    assert parse("square:amplitude=default").parameters == {"amplitude": None}
    assert parse("swing:C=auto").parameters == {"C": "auto"}
    with pytest.raises(ParameterError, match="swing:C=fast: C: 'fast' is not valid: a number in"):
        parse("swing:C=fast")


def test_what_has_no_name_continues_the_value_before() -> None:
    assert registry.split_spec("ppo:policy=a,b.onnx") == ("ppo", [("policy", "a,b.onnx")])
    with pytest.raises(ParameterError, match="NAME=VALUE is needed"):
        registry.split_spec("swing:0.6")


def test_a_controller_is_named_alike_in_all_verbs(tmp_path: Path) -> None:
    run, place = str(tmp_path / "run.mcap"), ("--config", "config/simulated.yaml")
    short = ("--for", "6", "--settle", "2")
    assert fishctl("simulate", "square:frequency=1.2", "--record", run, *place).returncode == 0
    for name in (("square:frequency=1.2",), ("square", "--frequency", "1.2")):
        again = json.loads(fishctl("rerun", run, *name, "--json").stdout)["stretches"]
        assert all(stretch["equal"] == stretch["ticks"] for stretch in again)
        compared = json.loads(fishctl("compare", *name, *short, *place, "--json").stdout)
        assert compared[0]["contestant"] == "square:frequency=1.2"
        swept = fishctl(
            "sweep", *name, "--folder", str(tmp_path / str(len(name))), *place, "--json"
        )
        assert json.loads(swept.stdout)[0]["parameters"] == {"frequency": 1.2}
    assert "did you mean 'swing'" in one_line(fishctl("rerun", run, "swin"))
    assert "; chosen again by swing:C=0.4\n" in fishctl("rerun", run, "swing:C=0.4").stdout
