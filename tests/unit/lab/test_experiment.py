"""Folder of an experiment: created once, resumed with equal settings, used by one process."""

import json
import os
import signal
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import click
import msgspec
import pytest
from click.testing import CliRunner
from rigs.processes import fishctl, one_line

from fishd.cli.experiment import Run, experiment_options
from fishd.core.errors import ConfigError, FishdError
from fishd.core.signals import Tick
from fishd.lab.experiment import (
    RESULT,
    Header,
    mark_folder,
    open_experiment,
    read_header,
)
from fishd.lab.session import VirtualSession
from fishd.recording import open_run

HEADER = Header(
    kind="sweep", on="live", settings={"seed": 1}, config={"plant": {"xi": 1.2}}, version="0.1"
)


def begin(path: Path, header: Header = HEADER) -> None:
    with open_experiment(path, header) as experiment:
        experiment.open_table(["x", "y"]).add({"x": 0.1, "y": True})


def resume(path: Path, header: Header = HEADER) -> list[dict[str, str]]:
    with open_experiment(path, header, resume=True) as experiment:
        return experiment.open_table(["x", "y"]).rows


@pytest.mark.parametrize(
    "content", [b"", b"{", b"null", b"\xff\xfe[", b'[{"thrust": 1}', b'["thrust"]']
)
def test_a_damaged_result_is_a_line_of_runs_and_an_unfinished_experiment_is_called_so(
    tmp_path: Path, content: bytes
) -> None:
    mark_folder(tmp_path / "run", "measure", "live", ["swing", "--C", "0.6"])
    header = msgspec.structs.replace(read_header(tmp_path / "run"), ended="")
    (tmp_path / "run" / "experiment.json").write_bytes(msgspec.json.encode(header))
    shown = fishctl("runs", "--folder", str(tmp_path))
    assert shown.stdout.rstrip().endswith("unfinished")
    assert "measure swing --C 0.6" in shown.stdout
    (tmp_path / "run" / RESULT).write_bytes(content)
    damaged = fishctl("runs", "--folder", str(tmp_path))
    assert damaged.returncode == 1
    assert f"fishctl: {tmp_path / 'run' / RESULT}: " in damaged.stderr
    assert damaged.stderr.endswith("delete it, the rows are kept\n")


def test_rows_are_there_again_and_one_that_a_kill_cut_off_is_not(tmp_path: Path) -> None:
    begin(tmp_path / "run")
    table = tmp_path / "run" / "rows.csv"
    for cut in ("0.2,", "0.2,1", "0.2\n"):
        whole = table.read_text()
        table.write_text(whole + cut)
        assert resume(tmp_path / "run") == [{"x": "0.1", "y": "1"}]
        assert table.read_text() == whole


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"settings": {"seed": 2}}, "began with seed = 1, now it is 2"),
        ({"config": {"plant": {"xi": 0.9}}}, "config.plant.xi = 1.2, now it is 0.9"),
        ({"config": {"plant": {"xi": 1.2, "mass": 1}}}, "fishd 0.1, whose configuration has no co"),
        ({"config": {"plant": {}}}, "configuration has config.plant.xi"),
        ({"on": "simulation"}, "on = live, now it is simulation"),
        ({"kind": "optimise"}, "kind = sweep, now it is optimise"),
    ],
)
def test_it_is_resumed_only_as_begun(tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    begin(tmp_path)
    header = {"kind": "sweep", "on": "live", "settings": HEADER.settings, "config": HEADER.config}
    with pytest.raises(ConfigError, match=named):
        resume(tmp_path, Header(**(header | changes)))
    config = {"plant": {"xi": 1.2}, "name": "x", "telemetry": {"address": "y"}}
    other_version = {"version": "0", "command": ["--json"], "config": config}
    assert resume(tmp_path, Header(**(header | other_version)))  # these may differ


@pytest.mark.parametrize(
    ("content", "named"),
    [("{}", "missing required field"), ("{", "truncated"), (None, "it has no experiment.json")],
)
def test_a_header_that_is_none_is_one_line(tmp_path: Path, content: str | None, named: str) -> None:
    if content is not None:
        (tmp_path / "experiment.json").write_text(content)
    with pytest.raises(ConfigError, match=named):
        resume(tmp_path)


def test_no_folder_is_used_twice(tmp_path: Path) -> None:
    begin(tmp_path / "run")
    with pytest.raises(ConfigError, match=r"run: the folder is not empty; resume it with --res"):
        begin(tmp_path / "run")
    (tmp_path / "file").touch()
    for name, named in (("file", "File exists"), ("file/run", "Not a directory")):
        with pytest.raises(ConfigError, match=f"the folder cannot be created: {named}"):
            begin(tmp_path / name)
    with (
        open_experiment(tmp_path / "run", HEADER, resume=True),
        pytest.raises(ConfigError, match="another experiment uses it"),
    ):
        resume(tmp_path / "run")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_rests_the_fish_and_keeps_what_was_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    swims, left = 0, 0
    swim, leave = VirtualSession._swim, VirtualSession.__exit__

    def interrupted(
        session: VirtualSession, controller: str, parameters: Mapping[str, Any], seconds: float
    ) -> list[Tick]:
        nonlocal swims
        swims += 1
        if swims == 3:
            os.kill(os.getpid(), number)
        return swim(session, controller, parameters, seconds)

    def impatient(session: VirtualSession, *exception: Any) -> None:
        nonlocal left
        os.kill(os.getpid(), number)  # again, while the fish is brought to rest
        leave(session, *exception)
        left += 1

    monkeypatch.setattr(VirtualSession, "_swim", interrupted)
    monkeypatch.setattr(VirtualSession, "__exit__", impatient)
    folder = tmp_path / "run"
    words = ["optimise", "square", "--frequency", "1:3", "--folder", str(folder)]
    done = fishctl(*words)
    assert (done.returncode, left) == (130, 1)
    assert done.stderr == (
        f"fishctl: interrupted, 2 candidates are kept; resume with: fishctl optimise --resume "
        f"{folder}\n"
    )
    assert (folder / "rows.csv").read_text().count("\n") == 3
    (listed,) = json.loads(fishctl("runs", "--folder", str(tmp_path), "--json").stdout)
    assert (listed["state"], listed["rows"]) == ("unfinished", 2)
    answer = folder / "result.json"
    assert listed["thrust"] == json.loads(answer.read_bytes())["thrust"]
    answer.unlink()
    (listed,) = json.loads(fishctl("runs", "--folder", str(tmp_path), "--json").stdout)
    assert listed["thrust"] is None, "not the luckiest of the candidates"


def test_an_experiment_is_resumed_by_its_own_verb_with_its_own_options(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    words = ["optimise", "square:amplitude=0.3", "--frequency", "1:3", "--budget", "12"]
    assert fishctl(*words, "--set", "plant.xi=1.1", "--folder", str(folder)).returncode == 1
    refused = one_line(fishctl("sweep", "--resume", str(folder)))
    assert f"it is of another verb: fishctl optimise --resume {folder}" in refused
    refused = one_line(fishctl("optimise", "--resume", str(tmp_path)))
    assert "no experiment to resume" in refused
    refused = one_line(fishctl("optimise", "--resume", str(folder), "--amplitude", "0.2"))
    assert "parameters.amplitude = 0.3, now it is 0.2" in refused
    done = fishctl("optimise", "--resume", str(folder))
    assert f"{folder}: 1 candidate measured already" in done.stdout
    assert done.stdout.startswith("fish: the default simulated fish, changed by --set\n")


def test_a_measurement_keeps_header_recording_and_result_and_is_listed(tmp_path: Path) -> None:
    folder = tmp_path / "first"
    words = ("measure", "swing:C=0.5", "--on", "simulation", "--for", "21", "--json")
    done = fishctl(*words, "--folder", str(folder))
    assert done.stderr == "fish: the default simulated fish\n"
    result = json.loads((folder / "result.json").read_bytes())
    assert result == json.loads(done.stdout)
    assert len(open_run(folder / "measure.mcap").ticks) == round(result["seconds"] / 0.05)
    (listed,) = json.loads(fishctl("runs", "--folder", str(tmp_path), "--json").stdout)
    assert (listed["name"], listed["kind"], listed["on"]) == ("first", "measure", "simulation")
    for key in ("thrust", "thrust_ci95", "total_ci95"):
        assert listed[key] == result[key]
    assert (listed["state"], listed["duration"]) == ("finished", result["seconds"])
    printed = fishctl("runs", "--folder", str(tmp_path)).stdout
    assert f"{1e3 * result['thrust']:.2f} ± {1e3 * result['total_ci95']:.2f}" in printed
    (folder / "experiment.json").write_text("{}")
    done = fishctl("runs", "--folder", str(tmp_path))
    assert done.returncode == 1
    assert f"fishctl: {folder}/experiment.json: fishd" in done.stderr


def test_a_verb_without_a_picture_is_an_experiment_without_plot() -> None:
    @click.group()
    def group() -> None: ...

    @group.command()
    @experiment_options()
    def verb(run: Run) -> None:
        run.echo(f"picture: {run.picture}")

    call = partial(CliRunner().invoke, group, catch_exceptions=False)
    done = call(["verb", "--on", "simulation"])
    assert done.output == "fish: the default simulated fish\npicture: None\n"
    assert "No such option '--plot'" in call(["verb", "--plot", "x.png"]).output


class Value(msgspec.Struct):
    """Result of a computation that takes long."""

    number: int


def test_what_takes_long_is_computed_once_and_again_only_if_it_failed(tmp_path: Path) -> None:
    def fail() -> Value:
        raise FishdError("no fish")

    with open_experiment(tmp_path, HEADER) as experiment:
        with pytest.raises(FishdError, match="no fish"):
            experiment.once("value.json", Value, fail)
        assert experiment.once("value.json", Value, lambda: Value(1)) == Value(1)
    with open_experiment(tmp_path, HEADER, resume=True) as experiment:
        assert experiment.once("value.json", Value, fail) == Value(1)
