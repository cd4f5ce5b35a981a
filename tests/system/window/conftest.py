"""A window of the daemon of a module, and one per test for tests that disturb it."""

from collections.abc import Iterator

import pytest
from rigs.processes import Daemon
from rigs.window_process import Browser, WindowProcess, open_page, run, running_window


@pytest.fixture(scope="module")
def shared_window(
    shared_daemon: Daemon, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[WindowProcess]:
    folder = tmp_path_factory.mktemp("window")
    with running_window(folder, fish=shared_daemon.endpoint) as window:

        async def wait_until_live() -> None:
            async with Browser(window.url) as browser, open_page(browser) as page:
                await page.until("ticks")

        run(wait_until_live())
        yield window


@pytest.fixture
def window(shared_window: WindowProcess, daemon: Daemon) -> WindowProcess:
    """Return the window of a module, whose fish is at rest."""
    return shared_window
