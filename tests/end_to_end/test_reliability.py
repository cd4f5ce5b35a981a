"""A little of what docs/reliability.md measures: however fishd ends, the servo comes to rest."""

import sys
from typing import Any

import msgspec
import pytest
from rigs.documents import ROOT
from rigs.processes import call

LONGEST_END = 3.0
"""From a signal to the end of the process, whatever hangs [s]."""


def measured(*arguments: str) -> Any:
    """What the tool finds that writes docs/reliability.md."""
    done = call(sys.executable, ROOT / "tools" / "reliability", *arguments, "--json", timeout=240)
    assert done.returncode in (0, 1), done.stderr
    assert done.stdout, done.stderr
    return msgspec.json.decode(done.stdout)


SIGNALS = {"SIGTERM": 0, "SIGKILL": -9, "SIGSTOP": None, "SIGCONT": None}
PHASES = ("statistics", "between ticks")


@pytest.fixture(scope="module")
def deaths() -> Any:
    """Six fishds that die side by side."""
    return measured("deaths", "--only", *SIGNALS, *PHASES)


@pytest.mark.realtime
@pytest.mark.parametrize(("name", "status"), SIGNALS.items())
def test_the_servo_is_neutral_soon_after_the_end_of_fishd_and_released_then(
    deaths: Any, name: str, status: int | None
) -> None:
    found = deaths[name]
    assert found["status"] == status
    limit = 0.3 if status != 0 else 0.6  # a countdown in pigpiod; a fade of 0.4 s
    assert found["neutral"] <= limit
    assert found["neutral"] < found["off"] <= found["neutral"] + 0.8
    if name == "SIGCONT":  # it goes on after a hang
        assert found["reason"] == "overrun"


@pytest.mark.realtime
@pytest.mark.parametrize("phase", PHASES)
def test_an_exception_outside_the_phases_ends_fishd_and_the_servo_comes_to_rest_first(
    deaths: Any, phase: str
) -> None:
    assert deaths[phase]["status"] == 1
    assert deaths[phase]["neutral"] < deaths[phase]["off"]


def test_a_fishd_that_is_killed_at_any_moment_leaves_no_pulses() -> None:
    kills = measured(*["kills", "--kills", "30", "--lanes", "6", "--seed", "4", "--limit", "60"])
    assert [kill for kill in kills if kill["off"] is None] == []
    assert len(kills) >= 10
    assert any(kill["swimming"] for kill in kills)
    assert any(kill["stopped"] for kill in kills)


@pytest.mark.parametrize(
    "kind",
    ["raising", "numbers", pytest.param("loading", marks=pytest.mark.realtime), "importing"],
)
def test_nothing_that_a_controller_does_ends_fishd(kind: str) -> None:
    assert measured("misbehaviour", "--only", kind)[kind]["ended"] == 0


@pytest.mark.realtime  # fishd itself has 2 s for an end in good order
@pytest.mark.parametrize(
    ("kind", "status"),
    [
        ("hanging-update", 1),
        ("hanging-close", 1),
        ("hanging-__init__", 0),
        ("unread-pipe", 0),
        ("unread-terminal", 0),
        ("hangup", 0),
    ],
)
def test_a_fishd_that_hangs_or_has_to_do_with_what_hangs_ends_soon(kind: str, status: int) -> None:
    found = measured("misbehaviour", "--only", kind)[kind]
    assert found["longest"] <= LONGEST_END
    assert found["statuses"] == [status]
