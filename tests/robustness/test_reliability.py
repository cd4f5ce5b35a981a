"""Short run of docs/reference/reliability.md: the servo goes to neutral after any end of fishd."""

import sys
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import msgspec
import pytest
from rigs.documents import ROOT
from rigs.processes import call

from reliability import misbehaviour

MAX_END_S = 3.0
"""Longest time from a signal to the end of the process, with anything hanging [s]."""


def measure(*arguments: str) -> Any:
    """Return the results of the tool that writes docs/reference/reliability.md."""
    done = call(sys.executable, ROOT / "tools" / "reliability", *arguments, "--json", timeout=200)
    assert done.returncode in (0, 1), done.stderr
    assert done.stdout, done.stderr
    return msgspec.json.decode(done.stdout)


SIGNALS = {"SIGTERM": 0, "SIGKILL": -9, "SIGSTOP": None, "SIGCONT": None}
PHASES = ("statistics", "between ticks")


@pytest.mark.realtime
def test_the_servo_is_neutral_soon_after_the_end_of_fishd_and_released_then() -> None:
    """Check six deaths in one test: they run in parallel, and a repetition measures all again."""
    deaths = measure("deaths", "--only", *SIGNALS, *PHASES)
    for name, status in SIGNALS.items():
        outcome = deaths[name]
        assert outcome["status"] == status, name
        limit = 0.3 if status != 0 else 0.6  # a countdown in pigpiod; a fade of 0.4 s
        assert outcome["neutral"] <= limit, name
        assert outcome["neutral"] < outcome["off"] <= outcome["neutral"] + 0.8, name
    assert deaths["SIGCONT"]["reason"] == "overrun"  # it continues after a hang
    for phase in PHASES:  # an exception outside the phases of a tick
        assert deaths[phase]["status"] == 1, phase
        assert deaths[phase]["neutral"] < deaths[phase]["off"], phase


@pytest.mark.realtime
def test_a_fishd_that_is_killed_at_any_moment_leaves_no_pulses() -> None:
    # With this seed, two of the first six are a SIGSTOP.
    kills = measure(*["kills", "--kills", "30", "--lanes", "6", "--seed", "10", "--limit", "100"])
    assert [kill for kill in kills if kill["off"] is None] == []
    assert len(kills) >= 10
    assert any(kill["swimming"] for kill in kills)
    assert any(kill["stopped"] for kill in kills)


@pytest.mark.parametrize("kind", ["raising", "numbers", "importing"])
def test_nothing_that_a_controller_does_ends_fishd(kind: str) -> None:
    assert misbehaviour.KINDS[kind]().ended == 0


@pytest.mark.realtime
def test_a_load_that_never_ends_ends_no_fishd() -> None:
    assert misbehaviour.loading(patience=3.0).ended == 0


@pytest.mark.realtime  # fishd itself has 2 s for an end in good order
@pytest.mark.parametrize(
    ("kind", "status"), [("hanging-update", 1), ("hanging-close", 1), ("hanging-__init__", 0)]
)
def test_a_fishd_that_hangs_ends_soon(kind: str, status: int) -> None:
    outcome = misbehaviour.KINDS[kind]()
    assert outcome.longest is not None
    assert outcome.longest <= MAX_END_S
    assert outcome.statuses == [status]


@pytest.mark.realtime
def test_a_fishd_that_says_what_nobody_reads_ends_soon() -> None:
    """Check three kinds in one test: they run in parallel, as they hardly compute."""
    kinds = ("unread-pipe", "unread-terminal", "hangup")
    with ThreadPoolExecutor(len(kinds)) as pool:
        outcomes = list(pool.map(lambda kind: misbehaviour.KINDS[kind](), kinds))
    for kind, outcome in zip(kinds, outcomes, strict=True):
        assert outcome.longest is not None, kind
        assert outcome.longest <= MAX_END_S, kind
        assert outcome.statuses == [0], kind
