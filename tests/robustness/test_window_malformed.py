"""Malformed requests and messages to the window."""

import asyncio
import os
from collections.abc import Iterator

import pytest
from rigs.malformed_messages import ATTACKS, answers, attack
from rigs.processes import Daemon
from rigs.window_process import Browser, open_page, run, running_window

MESSAGES = int(os.environ.get("MALFORMED_MESSAGES", "120"))
"""Number of messages of each kind; docs/reference/reliability.md has the result of 20000."""


@pytest.fixture(scope="module")
def port(shared_daemon: Daemon, tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    with running_window(tmp_path_factory.mktemp("window"), fish=shared_daemon.endpoint) as window:

        async def test() -> None:
            async with Browser(window.url) as browser, open_page(browser) as page:
                await page.until("ticks")

        run(test())
        yield window.port


@pytest.mark.parametrize("what", ATTACKS)
def test_malformed_messages_change_nothing_and_the_window_answers_on(
    port: int, daemon: Daemon, what: str
) -> None:
    attacker, size = ATTACKS[what]
    before = daemon.status()
    assert asyncio.run(attack(attacker, MESSAGES // size, 5, port)) == (0, [])
    assert answers(port)
    after = daemon.status()
    assert (after.mode, after.controller) == (before.mode, before.controller) == ("idle", "hold")
