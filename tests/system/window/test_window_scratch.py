"""The folder in which a window's experiments write: it ends with the window, or with the next."""

import os
import signal
from pathlib import Path

import pytest
from rigs.processes import Daemon, wait_until
from rigs.window_process import Browser, WindowProcess, open_page, running_window

SIMULATE = {"fish": "fish", "kind": "simulate", "options": {"controller": "swing", "seconds": 600}}


async def end_at_work(window: WindowProcess, number: signal.Signals) -> None:
    """Let a window end while a job of it writes."""
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.post("/api/jobs", SIMULATE)
        (folder,) = window.state.glob("*.scratch")
        assert folder.stat().st_mode & 0o777 == 0o700
        os.kill(window.pid, number)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
async def test_a_window_that_ends_leaves_no_folder_behind(
    daemon: Daemon, tmp_path: Path, number: signal.Signals
) -> None:
    with running_window(tmp_path, fish=daemon.endpoint) as window:
        await end_at_work(window, number)
        wait_until(lambda: not any(window.state.glob("*.scratch")))


async def test_the_folder_of_a_window_that_was_killed_ends_with_the_next_one(
    daemon: Daemon, tmp_path: Path
) -> None:
    with running_window(tmp_path, fish=daemon.endpoint) as window:
        await end_at_work(window, signal.SIGKILL)
        window.process.wait()
        (left,) = window.state.glob("*.scratch")
    with running_window(tmp_path, fish=daemon.endpoint) as window:
        assert [folder.exists() for folder in (left, *window.state.glob("*.scratch"))] == [
            False,
            True,
        ]
