"""Policies in a running fishd: set by name and by path, refused, listed, never late."""

import json
import pickle
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.policy_files import FLIP, card, linear, random_layers, write
from rigs.processes import PATIENCE, Daemon, Subscriber, one_line, running

from fishd.client import Fish
from fishd.controllers.policy.network import to_onnx


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folder of policies for the daemon and fishctl."""
    folder = tmp_path_factory.mktemp("fishd") / "policies"
    write(folder, FLIP, "flip")
    write(folder, to_onnx(linear(1.0), "tanh", card(tick=0.02)), "quick")
    write(folder, pickle.dumps({}), "torch")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FISHD_POLICIES", str(folder))
        yield folder


@pytest.fixture(scope="module")
def shared_daemon(folder: Path) -> Iterator[Daemon]:
    with running(folder.parent, "--set", "chatter.dwell=0") as daemon:
        yield daemon


@pytest.mark.realtime
def test_a_policy_that_shakes_the_servo_loses_command_and_everyone_is_told(
    folder: Path, tmp_path: Path
) -> None:
    def missed() -> int:
        with running(tmp_path) as daemon, Fish(daemon.endpoint, timeout=PATIENCE) as fish:
            return shake_servo(daemon, fish)

    # A real cost of ticks recurs each time; a short stall of the machine does not.
    assert any(missed() == 0 for _ in range(3))


def shake_servo(daemon: Daemon, fish: Fish) -> int:
    """Let a policy shake the servo until swing takes over; return the number of missed slots."""
    with (
        Subscriber(daemon.telemetry, b"event") as events,
        Subscriber(daemon.telemetry, b"tick") as ticks,
    ):
        events.connected()
        before = fish.status().missed_slots
        fish.set_controller("ppo", policy="flip")
        event = events.until(kind="fallback")
        assert (event["data"]["before"], event["data"]["controller"]) == ("ppo", "swing")
        assert ticks.until(controller="swing")["mode"] == "running"
        status = fish.status()
        assert (status.mode, status.controller) == ("running", "swing")
        assert status.fallback
        assert status.fallback.code == "chatter"
        assert "took over: chatter: ppo gave up" in daemon.fishctl("status").stdout
        fish.set_controller("ppo", policy="flip")
        assert fish.status().fallback is None
        return status.missed_slots - before


def test_a_named_policy_swims(daemon: Daemon) -> None:
    with Subscriber(daemon.telemetry, b"tick") as ticks:
        ticks.connected()
        done = daemon.fishctl("set-controller", "ppo", "--policy", "flip")
        assert (done.returncode, done.stderr) == (0, "")
        assert "running: ppo policy=flip" in done.stdout
        first = ticks.until(controller="ppo")
        angles = [first["phi_c"], *(ticks.message()["phi_c"] for _ in range(5))]
    assert angles == [0.42, -0.42, 0.42, -0.42, 0.42, -0.42]


def test_a_relative_path_is_that_of_the_one_who_asks(daemon: Daemon, tmp_path: Path) -> None:
    write(tmp_path / "elsewhere", FLIP, "mine")
    ask = ("set-controller", "ppo", "--policy", "./mine.onnx")
    done = daemon.fishctl_apart(*ask, cwd=tmp_path / "elsewhere")
    assert (done.returncode, done.stderr) == (0, "")
    assert f"ppo policy={tmp_path}/elsewhere/mine.onnx" in done.stdout


@pytest.mark.realtime
def test_a_policy_that_loads_costs_no_tick(folder: Path, tmp_path: Path) -> None:
    write(folder, to_onnx(random_layers(1, 64, 64, 1), "tanh", card()), "real")

    def missed() -> int:
        with running(tmp_path) as daemon, Subscriber(daemon.telemetry, b"tick") as ticks:
            before = ticks.message()
            daemon.fishctl("set-controller", "ppo", "--policy", "real")
            after = ticks.until(controller="ppo")
        return int(after["missed_slots"] - before["missed_slots"])

    # A real cost of ticks recurs each time; a short stall of the machine does not.
    assert any(missed() == 0 for _ in range(3))


def test_a_policy_that_cannot_be_used_is_refused_in_one_line(daemon: Daemon) -> None:
    for policy, message in {
        "flop": "no policy is named 'flop'; did you mean 'flip'? There are: default-fish, ",
        "torch": "this is a pickle, which could run any code",
        "quick": "it was trained at a tick of 20 ms, this robot's is 50 ms",
        "/nowhere/x.onnx": "ppo: policy: /nowhere/x.onnx: no such file [bad-parameter]",
    }.items():
        done = daemon.fishctl("set-controller", "ppo", "--policy", policy)
        assert done.returncode == 1
        assert message in one_line(done)
        assert daemon.status().mode == "idle"


def test_the_daemon_lists_its_policies_and_why_some_are_not_for_it(daemon: Daemon) -> None:
    found = json.loads(daemon.fishctl("policies", "--json").stdout)
    listed = {info["name"]: info for info in found}
    assert listed["flip"]["problem"] == ""
    assert listed["flip"]["card"]["amplitude"] == 0.42
    assert listed["torch"]["card"] is None
    text = daemon.fishctl("policies").stdout
    assert "flip" in text
    assert "    not here: this is a pickle, which could run any code" in text
    assert "    not here: it was trained at a tick of 20 ms, this robot's is 50 ms" in text
    shown = daemon.fishctl("policies", "show", "flip").stdout
    assert "steps: 8000" in shown
    assert "- name: instruction_angle\n  scale: 0.42" in shown


def test_a_service_finds_policies_in_its_state_folder(tmp_path: Path) -> None:
    write(tmp_path / "state" / "policies", FLIP, "kept")
    under = ("env", f"STATE_DIRECTORY={tmp_path / 'state'}")
    with running(tmp_path, under=under) as daemon, Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        assert "kept" in {info.name for info in fish.policies()}
        assert fish.set_controller("ppo", policy="kept").controller == "ppo"


def test_a_fishd_without_a_policy_loads_nothing_of_training(daemon: Daemon) -> None:
    daemon.fishctl("set-controller", "ppo", "--policy", "flip")
    loaded = Path(f"/proc/{daemon.process.pid}/maps").read_text()
    assert "onnxruntime" in loaded
    for package in ("torch", "matplotlib", "gymnasium"):
        assert f"/{package}/" not in loaded


def test_fishd_starts_with_a_policy_of_its_configuration(folder: Path, tmp_path: Path) -> None:
    write(folder, FLIP, "first")
    file = tmp_path / "fishd.yaml"
    file.write_text(
        "start:\n  controller: ppo\n  parameters:\n    policy: first\nchatter:\n  dwell: 0\n"
    )
    with (
        running(tmp_path, "--config", str(file)) as daemon,
        Fish(daemon.endpoint, timeout=PATIENCE) as fish,
    ):
        assert (fish.status().mode, fish.status().parameters) == ("running", {"policy": "first"})
    (folder / "first.onnx").unlink()
    status, _, errors = Daemon(tmp_path, "--config", str(file)).finish()
    assert status == 78
    refused = f"{file}:4: start.parameters.policy: ppo: policy: no policy is named 'first'"
    assert f"fishd: {refused}" in errors
