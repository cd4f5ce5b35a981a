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


@pytest.mark.parametrize(
    ("death", "status"), [("SIGTERM", 0), ("SIGINT", 0), ("SIGKILL", -9), ("SIGSTOP", None)]
)
def test_the_servo_is_neutral_soon_after_the_end_of_fishd_and_released_then(
    death: str, status: int | None
) -> None:
    found = outcome(death)
    assert found["status"] == status
    limit = 0.3 if status != 0 else 0.6  # a countdown in pigpiod; a fade of 0.4 s
    assert found["neutral"] <= limit
    assert found["neutral"] < found["off"] <= found["neutral"] + 0.8


@pytest.mark.parametrize(
    ("phase", "reason"),
    [
        ("read", "sensor-stale"),
        ("estimate", "estimate-error"),
        ("update", "controller-error"),
        ("guard", "controller-error"),
        ("publish", "publish-error"),
    ],
)
def test_an_exception_in_a_phase_of_the_tick_ends_in_neutral_and_fishd_goes_on(
    phase: str, reason: str
) -> None:
    found = outcome(phase)
    assert (found["status"], found["reason"]) == (None, reason)
    assert found["neutral"] <= 1.0
    assert found["neutral"] < found["off"]


@pytest.mark.parametrize("phase", ["statistics", "between ticks"])
def test_an_exception_outside_the_phases_ends_fishd_and_the_servo_comes_to_rest_first(
    phase: str,
) -> None:
    found = outcome(phase)
    assert found["status"] == 1
    assert found["neutral"] < found["off"]


def test_a_servo_that_cannot_be_driven_any_more_is_released() -> None:
    found = outcome("write")
    assert (found["status"], found["reason"]) == (None, "servo-link")
    assert found["off"] <= 0.5


def test_a_sensor_without_power_ends_in_neutral() -> None:
    found = outcome("unplugged")
    assert (found["status"], found["reason"]) == (None, "sensor-stale")
    assert found["neutral"] < found["off"] <= 1.2
