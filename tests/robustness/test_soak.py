"""Short run of each soak; docs/reference/reliability.md has the figures of long ones."""

import subprocess
import sys

import pytest
from rigs.documents import ROOT

TOOL = ROOT / "tools" / "reliability"


@pytest.mark.parametrize(
    ("arguments", "promise"),
    [
        (["simulated", "--ticks", "6000"], "no exception, every angle within limits"),
        (["virtual-pi", "--ticks", "400"], "no exception, every angle within limits"),
        (["channels", "--reads", "3000"], "no value of the wrong channel"),
    ],
)
def test_a_soak_keeps_its_promises(arguments: list[str], promise: str) -> None:
    run = subprocess.run(
        [sys.executable, str(TOOL), "soak", *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )
    assert run.returncode == 0, run.stderr
    assert promise in run.stdout
    assert run.stderr == f"soak: {arguments[0]}\n"
