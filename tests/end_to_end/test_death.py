"""However fishd ends, its servo comes to rest: the real daemon on a virtual Pi in this machine."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest

TOOL = Path(__file__).parents[2] / "tools" / "reliability.py"


def outcome(death: str) -> dict[str, Any]:
    """What the servo got, as the tool that writes docs/reliability.md measures it."""
    run = subprocess.run(
        [sys.executable, str(TOOL), "--death", death, "--json"],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert run.returncode == 0, run.stderr
    found: dict[str, dict[str, Any]] = msgspec.json.decode(run.stdout)
    return found[death]


@pytest.mark.parametrize(("death", "status"), [("SIGTERM", 0), ("SIGKILL", -9), ("SIGSTOP", None)])
def test_the_servo_is_neutral_soon_after_the_end_of_fishd_and_released_then(
    death: str, status: int | None
) -> None:
    found = outcome(death)
    assert found["status"] == status
    limit = 0.3 if status != 0 else 0.6  # a countdown in pigpiod; a fade of 0.4 s
    assert found["neutral"] <= limit
    assert found["neutral"] < found["off"] <= found["neutral"] + 0.8


def test_a_fishd_that_goes_on_after_a_hang_leaves_the_servo_released() -> None:
    found = outcome("SIGCONT")
    assert (found["status"], found["reason"]) == (None, "overrun")
    assert found["neutral"] <= 0.3
    assert found["neutral"] < found["off"] <= found["neutral"] + 0.8


@pytest.mark.parametrize("phase", ["statistics", "between ticks"])
def test_an_exception_outside_the_phases_ends_fishd_and_the_servo_comes_to_rest_first(
    phase: str,
) -> None:
    found = outcome(phase)
    assert found["status"] == 1
    assert found["neutral"] < found["off"]
