"""The true fishd meets controllers that raise, return and hang whatever they can."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import pytest

TOOL = Path(__file__).parents[2] / "tools" / "misbehaviour.py"
LONGEST_END = 3.0
"""From a signal to the end of the process, whatever hangs [s]."""


def outcome(kind: str) -> dict[str, Any]:
    """What came of it, as the tool that writes docs/reliability.md measures it."""
    run = subprocess.run(
        [sys.executable, str(TOOL), "--only", kind, "--json"],
        capture_output=True,
        text=True,
        check=False,
        timeout=180,
    )
    assert run.returncode in (0, 1), run.stderr
    assert run.stdout, run.stderr
    found: dict[str, dict[str, Any]] = msgspec.json.decode(run.stdout)
    return found[kind]


@pytest.mark.parametrize("kind", ["raising", "numbers", "loading", "importing"])
def test_nothing_that_a_controller_does_ends_fishd(kind: str) -> None:
    assert outcome(kind)["ended"] == 0


@pytest.mark.parametrize("kind", ["hanging-update", "hanging-close"])
def test_a_fishd_that_hangs_ends_soon_when_it_is_asked_to(kind: str) -> None:
    found = outcome(kind)
    assert found["longest"] <= LONGEST_END
    assert found["statuses"] == [1]


@pytest.mark.parametrize("kind", ["hanging-__init__", "unread-pipe", "unread-terminal", "hangup"])
def test_a_fishd_beside_which_something_hangs_stops_as_ever(kind: str) -> None:
    found = outcome(kind)
    assert found["longest"] <= LONGEST_END
    assert found["statuses"] == [0]
