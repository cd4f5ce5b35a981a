"""A window of the daemon of a module, and some of a single test for tests that disturb it."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.processes import Daemon, running
from rigs.virtual_pi_process import Pi, virtual_pi
from rigs.window_process import (
    Browser,
    WindowProcess,
    open_page,
    run_apart,
    running_window,
    wait_until_live,
)


@pytest.fixture(scope="module", autouse=True)
def _one_process() -> Iterator[None]:
    """Let no experiment of a page start further processes, each of which loads the laboratory."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LOKY_MAX_CPU_COUNT", "1")
        yield


@pytest.fixture(scope="module")
def shared_window(
    shared_daemon: Daemon, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[WindowProcess]:
    folder = tmp_path_factory.mktemp("window")
    with running_window(folder, fish=shared_daemon.endpoint) as window:
        run_apart(wait_until_live(window))
        yield window


@pytest.fixture
def window(shared_window: WindowProcess, daemon: Daemon) -> WindowProcess:
    """Return the window of a module, whose fish is at rest."""
    return shared_window


@pytest.fixture
def free_window(shared_window: WindowProcess, shared_daemon: Daemon) -> WindowProcess:
    """Return the window of a module, which no page drives any more, and whose fish is at rest."""

    async def release() -> None:
        async with Browser(shared_window.url) as browser, open_page(browser) as page:
            await page.drive()
            await page.post("release")

    run_apart(release())
    shared_daemon.at_rest()
    return shared_window


@pytest.fixture
def new_window(daemon: Daemon, tmp_path: Path) -> Iterator[WindowProcess]:
    """Yield a window of a single test, which hears its fish, and which no page drives yet."""
    with running_window(tmp_path, fish=daemon.endpoint) as process:
        run_apart(wait_until_live(process))
        yield process


@pytest.fixture
def own_window(own_daemon: Daemon, tmp_path: Path) -> Iterator[WindowProcess]:
    """Yield a window of a fishd that the test may kill."""
    with running_window(tmp_path, fish=own_daemon.endpoint) as process:
        yield process


@pytest.fixture
def pi(tmp_path: Path) -> Iterator[Pi]:
    """Yield a virtual Raspberry Pi with a true servo and a true sensor."""
    with virtual_pi(tmp_path) as pi:
        yield pi


@pytest.fixture
def pi_window(pi: Pi, tmp_path: Path) -> Iterator[WindowProcess]:
    """Yield a window of the fish on that Raspberry Pi."""
    with (
        running(tmp_path, *pi.settings) as daemon,
        running_window(tmp_path, fish=daemon.endpoint) as window,
    ):
        yield window
