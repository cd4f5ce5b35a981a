"""`fishctl compare`: a table, JSON and a picture, of simulated fish and of a running fishd."""

import json
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
from rigs.policy_files import write
from rigs.processes import fishctl

from fishd.config import Config
from fishd.lab.measurement import ThrustMeasurement, measure
from fishd.lab.session import Replaced, VirtualSession


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return fishctl("compare", *arguments)


def test_the_command_draws_a_picture_and_prints_a_table(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="install the extra 'lab'")
    picture = tmp_path / "contest.png"
    done = run("swing:C=0.5", "hold", "--seconds", "15", "--settle", "5", "--plot", str(picture))
    assert (done.returncode, done.stderr) == (0, "")
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "swing:C=0.5" in done.stdout
    fish, *table, verdict = done.stdout.splitlines()
    assert fish == "fish: the default simulated fish"
    assert max(len(line.rstrip()) for line in table) <= 80
    assert verdict == "Verdict: swing:C=0.5 wins: no other one has a thrust above zero."


def test_the_command_prints_json_with_every_run() -> None:
    done = run("swing", "square", "--seconds", "15", "--settle", "5", "--runs", "2", "--json")
    first, second = json.loads(done.stdout)
    assert (first["contestant"], second["contestant"]) == ("swing", "square")
    assert len(first["runs"]) == 2
    assert first["verdict"] == "wins"
    assert second["verdict"] == "loses"
    assert {"relative_thrust", "thrust", "frequency", "fullness", "form_factor"} <= set(first)


def test_a_refused_contestant_does_not_keep_the_others_from_swimming() -> None:
    options = ("--set", "amplitude_limit=0.31", "--seconds", "15", "--settle", "5")
    done = run("swing", "default-fish", *options, "--json")
    assert [standing["contestant"] for standing in json.loads(done.stdout)] == ["swing"]
    assert "\nfishctl: default-fish: left out: ppo: policy: " in done.stderr
    assert "0.42 rad" in done.stderr
    assert (done.returncode, done.stderr.count("\n")) == (1, 2)
    assert run("default-fish", *options).stderr.startswith("fishctl: ppo: policy: ")


def test_earlier_runs_of_a_controller_that_gives_up_stand_in_the_table(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    swum: list[str] = []

    def tiring(rig: VirtualSession, controller: str, *given: Any) -> ThrustMeasurement:
        swum.append(controller)
        if swum == ["swing", "sine", "swing"]:
            raise Replaced("swing gave up")
        return measure(rig, controller, *given)

    monkeypatch.setattr("fishd.client.Fish", nullcontext)
    monkeypatch.setattr(
        "fishd.lab.compare.piloted_session.PilotedSession",
        lambda *_, **__: VirtualSession(Config()),
    )
    monkeypatch.setattr("fishd.lab.compare.live.measure", tiring)
    done = run("swing", "sine", "--on", "live", "--for", "25", "--runs", "2")
    left_out = "left out after 1 of 2 runs, which are in the table: swing gave up"
    assert done.stderr == f"fishctl: swing: {left_out}\n"
    rows = [line for line in done.stdout.splitlines() if line.startswith("swing")]
    assert (done.returncode, len(rows)) == (1, 1)
    assert "Verdict: swing wins: it thrusts " in done.stdout


def test_a_misspelt_path_of_a_policy_is_reported_before_anything_swims() -> None:
    done = run("swing", "runs/frist.onnx", "--seconds", "15", "--settle", "5")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "fishctl: ppo: policy: runs/frist.onnx: no such file\n"
    done = run("~no-such-user.onnx", "--seconds", "15", "--settle", "5")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "fishctl: ppo: policy: ~no-such-user.onnx: no such file\n"


def test_a_wrong_contestant_is_one_line() -> None:
    done = run("swing:C=2")
    assert "fishctl: swing: C: 2.0 is not valid: a number in [0, 1]" in done.stderr
    assert (done.stdout, done.returncode, done.stderr.count("\n")) == ("", 1, 1)


@pytest.mark.slow
def test_policies_without_their_packages_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    done = run("--seconds", "15", "--settle", "5")
    assert (done.returncode, done.stderr.count("\n")) == (0, 1)
    assert "left out, as the extra 'policy' is missing: default-fish" in done.stderr
    assert all(line == line.rstrip() for line in done.stdout.splitlines())


def test_a_takeover_from_a_policy_is_reported(tmp_path: Path) -> None:
    shaking = str(write(tmp_path))
    done = run(shaking, "--seconds", "20")
    assert done.returncode == 0
    assert f"fishctl: {shaking}: another controller took over: ppo gave up: " in done.stderr
