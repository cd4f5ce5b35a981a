"""The folder in which a window's experiments write: it ends with the window, however that ends."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.processes import Daemon, wait_until
from rigs.window_process import Browser, WindowProcess, open_page, running_window

START = {
    "idle": None,
    "simulate": {"controller": "swing", "seconds": 600},
    "measure": {"controller": "square", "seconds": 60},
}
"""Options of the job that a window runs when it is killed, by its kind; none for no job."""


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the folder for temporary files of the programs that are started."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    return folder


@pytest.fixture
def window(daemon: Daemon, tmp_path: Path, temporary: Path) -> Iterator[WindowProcess]:
    """Yield a window that the test may kill."""
    with running_window(tmp_path, fish=daemon.endpoint) as process:
        yield process


def children_of(pid: int) -> list[int]:
    """Return the processes that the threads of a process have started, the earliest first."""
    files = Path(f"/proc/{pid}/task").glob("*/children")
    return sorted(int(word) for file in files for word in file.read_text().split())


@pytest.mark.parametrize("kind", START)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
async def test_a_window_that_ends_leaves_no_folder_behind(
    window: WindowProcess, temporary: Path, kind: str, number: signal.Signals
) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.until("ticks")
        await page.drive()
        if options := START[kind]:
            body = {"fish": "fish", "kind": kind, "options": options}
            await page.post("/api/jobs", body)
            (folder,) = temporary.iterdir()
            assert folder.stat().st_mode & 0o777 == 0o700
            wait_until(lambda: len(children_of(window.pid)) == 2)
        os.kill(window.pid, number)
    wait_until(lambda: not any(temporary.iterdir()))


async def test_a_job_that_outlives_its_window_keeps_the_folder_until_it_ends(
    window: WindowProcess, temporary: Path
) -> None:
    children: list[int] = []

    async with Browser(window.url) as browser, open_page(browser) as page:
        body = {"fish": "fish", "kind": "simulate", "options": START["simulate"]}
        await page.post("/api/jobs", body)
        wait_until(lambda: len(children_of(window.pid)) == 2)
        children.extend(children_of(window.pid))
        os.kill(children[1], signal.SIGSTOP)
        os.kill(window.pid, signal.SIGKILL)
    window.process.wait()
    remover, job = children
    awaited = Path(f"/proc/{remover}/fd/0").readlink()
    assert awaited in [end.readlink() for end in Path(f"/proc/{job}/fd").iterdir()]
    assert len(list(temporary.iterdir())) == 1
    os.kill(job, signal.SIGCONT)
    wait_until(lambda: not any(temporary.iterdir()))
