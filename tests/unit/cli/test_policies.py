"""`fishctl policies` and `--policy` where no fishd runs."""

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
def nobody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """No daemon is running; the folder is the only one with policies."""
    folder = tmp_path / "policies"
    monkeypatch.delenv("FISHD_ENDPOINT", raising=False)
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr("fishd.core.addresses._SERVICE", tmp_path / "service")
    monkeypatch.setattr(library, "folders", lambda: [folder])
    return folder


def invoke(*arguments: str) -> Result:
    return CliRunner().invoke(fishctl, arguments)


def test_without_a_daemon_the_policies_of_this_machine_are_listed(nobody: Path) -> None:
    write(nobody, FLIP, "flip")
    write(nobody, b"PK", "torch")
    write(nobody, to_onnx(linear(1.0), "tanh", card(tick=0.02, amplitude=0.8)), "wide")
    done = invoke("policies")
    assert done.exit_code == 0
    assert "fishctl: no fishd is running; these are the policies of this machine" in done.stderr
    head, *rows = done.stdout.splitlines()
    heads = "name sees Φ [rad] tick trained in steps relative thrust created folder"
    assert head.split() == heads.split()
    assert rows[0].split() == [
        *("flip", "forces", "0.42", "50", "ms", "simulation", "8000", "98.7%", "2026-11-21"),
        str(nobody),
    ]
    assert rows[1].split() == ["torch", *["–"] * 7, str(nobody)]
    assert rows[2].startswith("    not here: this is a zip archive as torch writes")
    assert rows[3].startswith("wide   forces  0.8")
    assert len(rows) == 4


def test_where_there_are_none_it_says_where_they_belong(nobody: Path) -> None:
    done = invoke("policies")
    assert (done.exit_code, done.stdout) == (0, "")
    assert done.stderr.endswith(f"no policies here; put .onnx files into {nobody}\n")


def test_an_endpoint_that_is_named_must_answer(tmp_path: Path) -> None:
    done = invoke("--endpoint", f"ipc://{tmp_path}/nobody", "policies")
    assert isinstance(done.exception, NoDaemon)
    done = invoke("policies", "--endpoint", f"ipc://{tmp_path}/nobody", "show", "flip")
    assert isinstance(done.exception, NoDaemon)


def test_the_whole_card_of_a_name_or_a_file_is_shown(nobody: Path, tmp_path: Path) -> None:
    for policy in ("flip", str(write(tmp_path, FLIP, "copy"))):
        write(nobody, FLIP, "flip")
        shown = invoke("policies", "show", policy).stdout
        for line in ("tick: 0.05", "amplitude: 0.42", "  algorithm: by hand", "      n_steps: 128"):
            assert f"\n{line}\n" in shown


def test_what_is_no_policy_cannot_be_shown_and_says_why(nobody: Path) -> None:
    path = write(nobody, b"\x80\x04", "torch")
    done = invoke("policies", "show", "torch")
    assert isinstance(done.exception, PolicyError)
    assert str(done.exception).startswith(f"{path}: this is a pickle")
    done = invoke("policies", "show", "touch")
    assert str(done.exception).startswith("no policy is named 'touch'; did you mean 'torch'? Th")


def test_a_strangers_file_says_nothing_to_the_terminal_and_keeps_the_table_narrow(
    nobody: Path,
) -> None:
    past = replace(PROVENANCE, on="\x1b[2Jrobot" + "x" * 10_000, note="\x1b]0;title\x07")
    evil = replace(card(), provenance=replace(past, steps=10**50))
    write(nobody, to_onnx(linear(1.0), "tanh", evil), "evil")
    for done in (
        invoke("policies"),
        invoke("policies", "show", "evil"),
        invoke("policies", "--json"),
    ):
        assert done.exit_code == 0
        assert "robot" in done.stdout
        assert "\x1b" not in done.stdout
    assert max(map(len, invoke("policies").stdout.splitlines())) < 200 + len(str(nobody))


def test_a_policy_can_be_simulated_by_name_and_by_a_relative_path(
    nobody: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(nobody, FLIP, "flip")
    monkeypatch.chdir(nobody)
    for given, shown in (
        ("flip", "flip until 1.95 s, then swing;"),
        ("flip.onnx", f"{path} until"),
    ):
        done = invoke("simulate", "ppo", "--policy", given, "--seconds", "2", "--settle", "1")
        assert f"ppo policy={shown}" in done.stdout


def test_the_option_for_a_policy_explains_itself_and_completes_names_and_files(
    nobody: Path,
) -> None:
    for name in ("flip", "flop", "swim"):
        write(nobody, FLIP, name)
    shown = invoke("set-controller", "ppo", "--help").stdout
    assert "--policy NAME|FILE" in shown
    assert "required" in shown
    verb = fishctl.get_command(click.Context(fishctl), "set-controller")
    assert isinstance(verb, click.Group)
    ppo = verb.get_command(click.Context(verb), "ppo")
    assert ppo
    option = next(param for param in ppo.params if "--policy" in param.opts)
    found = option.shell_complete(click.Context(ppo), "fl")
    assert [(item.value, item.type) for item in found] == [
        ("fl", "file"), ("flip", "plain"), ("flop", "plain")
    ]  # fmt: skip


@pytest.mark.slow
def test_fishctl_that_only_asks_loads_no_numbers() -> None:
    program = (
        "import sys; from fishd.controllers import registry; from fishd.client import Fish; "
        "registry.describe('ppo'); print([m for m in ('numpy', 'onnx', 'onnxruntime') "
        "if m in sys.modules])"
    )
    assert processes.call(sys.executable, "-c", program).stdout == "[]\n"
