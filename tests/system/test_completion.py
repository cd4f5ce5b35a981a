"""Completions that the shell offers for an incomplete command line of fishctl."""

import os
import shutil
import sys
from pathlib import Path

import pytest
from rigs.processes import FISHCTL, Daemon, call, wait_until


def complete(*words: str) -> list[str]:
    """Return the completions that bash gets for these words, the last of which is incomplete."""
    shell = {"_FISHCTL_COMPLETE": "bash_complete", "COMP_CWORD": str(len(words))}
    shell["COMP_WORDS"] = "\n".join(("fishctl", *words))
    done = call(FISHCTL, env=os.environ | shell, check=True)
    assert done.stderr == ""
    return done.stdout.split()


def test_set_parameter_offers_the_parameters_of_the_running_controller(daemon: Daemon) -> None:
    daemon.fishctl("set-controller", "swing")
    to = ("--endpoint", daemon.endpoint)
    names = ["plain,C", "plain,amplitude", "plain,longest_half_period", "plain,lead"]
    for words, expected in (
        ((*to, "set-parameter", ""), names),
        (("set-parameter", *to, "C", "0.3", "am"), ["plain,amplitude"]),
        ((*to, "set-parameter", "C", ""), ["plain,auto"]),
    ):
        # The shell waits for fishd only briefly, and offers nothing if that is too short.
        wait_until(lambda words=words, expected=expected: complete(*words) == expected)


def test_set_parameter_offers_nothing_without_a_daemon(tmp_path: Path) -> None:
    assert complete("--endpoint", f"ipc://{tmp_path}/nobody", "set-parameter", "") == []


def test_set_offers_keys_of_the_configuration() -> None:
    keys = complete("simulate", "swing", "--set", "plant.")
    assert "plain,plant.omega0=" in keys
    assert all(key.startswith("plain,plant.") for key in keys)
    assert "plain,plant=" not in complete("config", "show", "--set", "pl")


def test_compare_offers_controllers_and_policies() -> None:
    assert complete("compare", "sw") == ["file,sw", "plain,swing"]
    assert "plain,default-fish" in complete("compare", "swing", "def")
    assert "plain,remote" not in complete("compare", "")


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
def test_bash_itself_completes_named_policies_and_files() -> None:
    folder = Path(sys.executable).parent
    script = """
        eval "$(fishctl completion bash)"
        compopt() { :; }
        COMP_WORDS=(fishctl set-controller ppo --policy def); COMP_CWORD=4
        _fishctl_completion fishctl
        echo "${COMPREPLY[@]}"
    """
    path = {"PATH": f"{folder}:{os.environ['PATH']}"}
    done = call("bash", "--norc", "-c", script, env=os.environ | path, check=True)
    assert done.stdout.split() == ["default-fish"]
