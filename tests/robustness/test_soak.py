"""A short run of each soak; docs/reference/reliability.md has the figures of long ones."""

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


@pytest.mark.parametrize(
    ("soak", "sabotage", "promise"),
    [
        (
            ["simulated", "--ticks", "5000"],
            "from fishd.control.guard import Guard\n"
            "Guard.apply = lambda self, command, previous: float(command)",
            "rad",
        ),
        (
            ["virtual-pi", "--ticks", "300"],
            "from fishd.hardware.force_sensor.sampled_sensor import SampledSensor\n"
            "read, kept = SampledSensor.read, []\n"
            "SampledSensor.read = lambda *given: kept.append(read(*given)) or kept[-1]",
            "objects are left behind per tick",
        ),
    ],
)
def test_a_broken_promise_is_noticed(soak: list[str], sabotage: str, promise: str) -> None:
    """The same soaks with a guard that lets everything through, and with parts that leak."""
    program = (
        f"import runpy, sys; sys.argv[1:] = ['soak', *{soak!r}]\n"
        f"{sabotage}\nrunpy.run_path({str(TOOL)!r}, run_name='__main__')"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=200
    )
    assert run.returncode == 1
    assert "BROKEN" in run.stderr
    assert promise in run.stderr
