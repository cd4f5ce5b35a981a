"""Malformed requests and messages to the window."""

import os
from collections.abc import Iterator

import pytest
from rigs.malformed_messages import ATTACKS, answers, attack
from rigs.processes import Daemon
from rigs.window_process import run_apart, running_window, wait_until_live

MESSAGES = int(os.environ.get("MALFORMED_MESSAGES", "120"))
"""Number of messages of each kind; docs/reference/reliability.md has the result of 20000."""


@pytest.fixture(scope="module")
def port(shared_daemon: Daemon, tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    with running_window(tmp_path_factory.mktemp("window"), fish=shared_daemon.endpoint) as window:
        run_apart(wait_until_live(window))
        yield window.port


@pytest.mark.parametrize("what", ATTACKS)
async def test_malformed_messages_change_nothing_and_the_window_answers_on(
    port: int, daemon: Daemon, what: str
) -> None:
    attacker, size = ATTACKS[what]
    before = daemon.status()
    assert await attack(attacker, MESSAGES // size, 5, port) == (0, [])
    assert answers(port)
    after = daemon.status()
    assert (after.mode, after.controller) == (before.mode, before.controller) == ("idle", "hold")
