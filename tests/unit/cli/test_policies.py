"""`fishctl policies` and `--policy` where no fishd runs."""

import json
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result
from msgspec.structs import replace
from rigs import processes
from rigs.policy_files import FLIP, PROVENANCE, card, linear, write

from fishd.cli.main import fishctl
from fishd.controllers.policy import library
from fishd.controllers.policy.network import to_onnx
from fishd.core.errors import NoDaemon, PolicyError


@pytest.fixture(autouse=True)
def policy_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """Folder that is the only one with policies, while no daemon runs."""
    folder = tmp_path / "policies"
    monkeypatch.delenv("FISHD_ENDPOINT", raising=False)
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr("fishd.core.addresses.SERVICE_SOCKET", tmp_path / "service")
    monkeypatch.setattr(library, "folders", lambda: [folder])
    return folder


def invoke(*arguments: str) -> Result:
    return CliRunner().invoke(fishctl, arguments)


def test_without_a_daemon_the_policies_of_this_machine_are_listed(policy_folder: Path) -> None:
    write(policy_folder, FLIP, "flip")
    write(policy_folder, b"PK", "torch")
    write(policy_folder, to_onnx(linear(1.0), "tanh", card(tick=0.02, amplitude=0.8)), "wide")
    done = invoke("policies")
    assert done.exit_code == 0
    assert done.stderr.startswith("fishctl: no fishd at ipc://")
    assert "no process listens there; these are the policies of this machine" in done.stderr
    head, *rows = done.stdout.splitlines()
    heads = "name observes Φ [rad] tick trained in steps relative thrust created folder"
    assert head.split() == heads.split()
    assert rows[0].split() == [
        *("flip", "forces", "0.42", "50", "ms", "simulation", "8000", "98.7%", "2026-11-21"),
        str(policy_folder),
    ]
    assert rows[1].split() == ["torch", *["–"] * 7, str(policy_folder)]
    assert rows[2].startswith("    not here: this is a zip archive as torch writes")
    assert rows[3].startswith("wide   forces    0.8")
    assert len(rows) == 4


def test_a_name_without_a_verb_shows_that_policy(policy_folder: Path) -> None:
    write(policy_folder, FLIP, "flip")
    assert invoke("policies", "flip").stdout == invoke("policies", "show", "flip").stdout != ""
    assert json.loads(invoke("policies", "--json", "flip").stdout)["name"] == "flip"
    done = invoke("policies", "flop")
    assert (done.exit_code, type(done.exception)) == (1, PolicyError)
    assert "no policy is named 'flop'; did you mean 'flip'?" in str(done.exception)


def test_without_policies_it_names_their_folder(policy_folder: Path) -> None:
    done = invoke("policies")
    assert (done.exit_code, done.stdout) == (0, "")
    assert done.stderr.endswith(f"no policies here; put .onnx files into {policy_folder}\n")


def test_an_endpoint_that_is_named_must_answer(tmp_path: Path) -> None:
    done = invoke("--endpoint", f"ipc://{tmp_path}/nothing", "policies")
    assert isinstance(done.exception, NoDaemon)
    done = invoke("policies", "--endpoint", f"ipc://{tmp_path}/nothing", "show", "flip")
    assert isinstance(done.exception, NoDaemon)


def test_the_whole_card_of_a_name_or_a_file_is_shown(policy_folder: Path, tmp_path: Path) -> None:
    for policy in ("flip", str(write(tmp_path, FLIP, "copy"))):
        write(policy_folder, FLIP, "flip")
        shown = invoke("policies", "show", policy).stdout
        for line in ("tick: 0.05", "amplitude: 0.42", "  algorithm: by hand", "      n_steps: 128"):
            assert f"\n{line}\n" in shown


def test_a_file_without_a_policy_is_refused_with_the_reason(policy_folder: Path) -> None:
    path = write(policy_folder, b"\x80\x04", "torch")
    done = invoke("policies", "show", "torch")
    assert isinstance(done.exception, PolicyError)
    assert str(done.exception).startswith(f"{path}: this is a pickle")


def test_control_characters_of_a_file_do_not_reach_the_terminal(policy_folder: Path) -> None:
    provenance = replace(PROVENANCE, on="\x1b[2Jrobot" + "x" * 10_000, note="\x1b]0;title\x07")
    hostile_card = replace(card(), provenance=replace(provenance, steps=10**50))
    write(policy_folder, to_onnx(linear(1.0), "tanh", hostile_card), "evil")
    commands = (("policies",), ("policies", "show", "evil"), ("policies", "--json"))
    for done in (invoke(*words) for words in commands):
        assert done.exit_code == 0
        assert "robot" in done.stdout
        assert "\x1b" not in done.stdout
    assert max(map(len, invoke("policies").stdout.splitlines())) < 200 + len(str(policy_folder))


def test_a_policy_can_be_simulated_by_name_and_by_a_relative_path(
    policy_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(policy_folder, FLIP, "flip")
    monkeypatch.chdir(policy_folder)
    named = f"{path} until"
    for given, shown in (("flip", "flip until 1.95 s, then swing;"), ("flip.onnx", named)):
        done = invoke("simulate", "ppo", "--policy", given, "--seconds", "2", "--settle", "1")
        assert f"ppo policy={shown}" in done.stdout


def test_the_option_for_a_policy_completes_names_and_files(policy_folder: Path) -> None:
    for name in ("flip", "flop", "swim"):
        write(policy_folder, FLIP, name)
    shown = invoke("set-controller", "ppo", "--help").stdout
    assert "--policy NAME|FILE" in shown
    assert "required" in shown
    verb = fishctl.get_command(click.Context(fishctl), "set-controller")
    ppo = verb.get_command(click.Context(verb), "ppo")
    option = next(param for param in ppo.params if "--policy" in param.opts)
    items = option.shell_complete(click.Context(ppo), "fl")
    assert [(item.value, item.type) for item in items] == [
        ("fl", "file"), ("flip", "plain"), ("flop", "plain")
    ]  # fmt: skip


@pytest.mark.slow
def test_a_plain_request_of_fishctl_loads_no_numpy() -> None:
    program = (
        "import sys; from fishd.controllers import registry; from fishd.client import Fish; "
        "registry.describe('ppo'); print([m for m in ('numpy', 'onnx', 'onnxruntime') "
        "if m in sys.modules])"
    )
    assert processes.call(sys.executable, "-c", program).stdout == "[]\n"
