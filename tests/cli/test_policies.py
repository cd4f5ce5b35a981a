"""`fishctl policies` and `--policy` where no fishd runs."""

import subprocess
import sys
from pathlib import Path

import click
import pytest
from click.testing import CliRunner, Result
from policy_files import FLIP, PROVENANCE, card, linear, write

from fishd.cli.main import fishctl
from fishd.errors import NoDaemon, PolicyError
from fishd.policies import library
from fishd.policies.network import to_onnx


@pytest.fixture(autouse=True)
def nobody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """No daemon is running; the folder is the only one with policies."""
    folder = tmp_path / "policies"
    monkeypatch.delenv("FISHD_ENDPOINT", raising=False)
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr("fishd.addresses._SERVICE", tmp_path / "service")
    monkeypatch.setattr(library, "folders", lambda: [folder])
    return folder


def call(*arguments: str) -> Result:
    return CliRunner().invoke(fishctl, arguments)


def test_without_a_daemon_the_policies_of_this_machine_are_listed(nobody: Path) -> None:
    write(nobody, FLIP, "flip")
    write(nobody, b"PK", "torch")
    write(nobody, to_onnx(linear(1.0), "tanh", card(tick=0.02, amplitude=0.8)), "wide")
    done = call("policies")
    assert done.exit_code == 0
    assert "fishctl: no fishd is running; these policies are found from here" in done.stderr
    head, *rows = done.stdout.splitlines()
    assert head.split() == [
        "name", "Φ", "[rad]", "tick", "trained", "in", "steps", "efficiency", "created", "folder"
    ]  # fmt: skip
    assert rows[0].split() == [
        "flip", "0.42", "50", "ms", "simulation", "8000", "98.7%", "2026-11-21", str(nobody)
    ]  # fmt: skip
    assert rows[1].split() == ["torch", *["–"] * 6, str(nobody)]
    assert rows[2].startswith("    not here: this is a zip archive as torch writes")
    assert rows[3].startswith("wide   0.8")
    assert len(rows) == 4


def test_where_there_are_none_it_says_where_they_belong(nobody: Path) -> None:
    done = call("policies")
    assert (done.exit_code, done.stdout) == (0, "")
    assert done.stderr.endswith(f"none; put .onnx files into {nobody}\n")


def test_an_endpoint_that_is_named_must_answer(tmp_path: Path) -> None:
    done = call("--endpoint", f"ipc://{tmp_path}/nobody", "policies")
    assert isinstance(done.exception, NoDaemon)
    done = call("policies", "--endpoint", f"ipc://{tmp_path}/nobody", "show", "flip")
    assert isinstance(done.exception, NoDaemon)


def test_the_whole_card_of_a_name_or_a_file_is_shown(nobody: Path, tmp_path: Path) -> None:
    for policy in ("flip", str(write(tmp_path, FLIP, "copy"))):
        write(nobody, FLIP, "flip")
        shown = call("policies", "show", policy).stdout
        for line in ("tick: 0.05", "amplitude: 0.42", "  algorithm: by hand", "      n_steps: 128"):
            assert f"\n{line}\n" in shown


def test_what_is_no_policy_cannot_be_shown_and_says_why(nobody: Path) -> None:
    path = write(nobody, b"\x80\x04", "torch")
    done = call("policies", "show", "torch")
    assert isinstance(done.exception, PolicyError)
    assert str(done.exception).startswith(f"{path}: this is a pickle")
    done = call("policies", "show", "touch")
    assert str(done.exception).startswith("no policy is named 'touch'; did you mean 'torch'? Th")


def test_a_strangers_file_says_nothing_to_the_terminal(nobody: Path) -> None:
    import msgspec

    from fishd.policies.network import to_onnx

    past = msgspec.structs.replace(PROVENANCE, on="\x1b[2Jrobot", note="\x1b]0;title\x07")
    evil = msgspec.structs.replace(card(), provenance=past)
    write(nobody, to_onnx(linear(1.0), "tanh", evil), "evil")
    for done in (call("policies"), call("policies", "show", "evil"), call("policies", "--json")):
        assert done.exit_code == 0
        assert "robot" in done.stdout
        assert "\x1b" not in done.stdout


def test_absurd_words_in_a_file_do_not_spoil_the_table(nobody: Path) -> None:
    import msgspec

    from fishd.policies.network import to_onnx

    past = msgspec.structs.replace(PROVENANCE, on="x" * 10_000, steps=10**50)
    write(
        nobody,
        to_onnx(linear(1.0), "tanh", msgspec.structs.replace(card(), provenance=past)),
        "odd",
    )
    table = call("policies").stdout
    assert max(len(line) for line in table.splitlines()) < 200 + len(str(nobody))


def test_a_policy_can_be_simulated_by_name_and_by_a_relative_path(
    nobody: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(nobody, FLIP, "flip")
    monkeypatch.chdir(nobody)
    short = ("--seconds", "2", "--settle", "1")
    assert "ppo policy=flip\n" in call("simulate", "ppo", "--policy", "flip", *short).stdout
    assert f"ppo policy={path}\n" in call("simulate", "ppo", "--policy", "flip.onnx", *short).stdout


def test_a_shell_completes_names_and_files(nobody: Path) -> None:
    for name in ("flip", "flop", "swim"):
        write(nobody, FLIP, name)
    verb = fishctl.get_command(click.Context(fishctl), "set-controller")
    assert isinstance(verb, click.Group)
    ppo = verb.get_command(click.Context(verb), "ppo")
    assert ppo
    option = next(param for param in ppo.params if "--policy" in param.opts)
    found = option.shell_complete(click.Context(ppo), "fl")
    assert [(item.value, item.type) for item in found] == [
        ("flip", "plain"), ("flop", "plain"), ("fl", "file")
    ]  # fmt: skip


def test_the_help_of_ppo_says_what_a_policy_is() -> None:
    text = call("set-controller", "ppo", "--help").stdout
    assert "--policy NAME|FILE" in text
    assert "required" in text


def test_fishctl_that_only_asks_loads_no_numbers() -> None:
    program = (
        "import sys; from fishd.controllers import registry; from fishd.client import Fish; "
        "registry.describe('ppo'); print([m for m in ('numpy', 'onnx', 'onnxruntime') "
        "if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "[]\n"
