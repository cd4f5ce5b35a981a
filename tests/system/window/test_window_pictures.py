"""Pictures of runs: only what a run itself left in its folder, and never more than fits a page."""

import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
from rigs.processes import fishctl
from rigs.window_process import Browser, WindowProcess

from fishd.window.pictures import MAX_PICTURE_BYTES

PNG = b"\x89PNG\r\n\x1a\n a picture"
SECRET = b"a file of another program"


def write_sparse(path: Path, size: int) -> None:
    """Write a file of this size, which takes no space on the disk."""
    with path.open("wb") as file:
        file.truncate(size)


def link_to_secret(path: Path) -> None:
    """Make a symbolic link to a file outside of the runs."""
    outside = path.parents[2] / "secret"
    outside.write_bytes(SECRET)
    path.symlink_to(outside)


def link_folder(path: Path) -> None:
    """Replace the folder of a run by a symbolic link to one outside of the runs."""
    outside = path.parents[2] / "outside"
    outside.mkdir()
    (outside / path.name).write_bytes(SECRET)
    path.parent.rmdir()
    path.parent.symlink_to(outside)


def bind_socket(path: Path) -> None:
    """Make a Unix socket."""
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(path))


REFUSED: dict[str, tuple[Callable[[Path], object], str]] = {
    "link": (link_to_secret, "'measure-1/measure.png' is a symbolic link; a regular file is need"),
    "linked folder": (link_folder, "'measure-1' is a symbolic link; a folder is needed"),
    "pipe": (os.mkfifo, "'measure-1/measure.png' is a named pipe; a regular file is needed"),
    "socket": (bind_socket, "'measure-1/measure.png' is a socket; a regular file is needed"),
    "folder": (os.mkdir, "'measure-1/measure.png' is a folder; a regular file is needed"),
    "long": (
        lambda path: write_sparse(path, MAX_PICTURE_BYTES + 1),
        "'measure-1/measure.png' is longer than 20 MB",
    ),
    "none": (lambda path: None, "no recording 'measure-1', neither a file nor a name in"),
    "file": (
        lambda path: (path.parent.rmdir(), path.parent.write_bytes(SECRET)),
        "'measure-1' is a file; a folder is needed",
    ),
}


@pytest.fixture
def picture(window: WindowProcess) -> Path:
    """Return the path of the picture of a run, which is not there yet."""
    runs = window.state.parent / "runs"
    number = 1
    while os.path.lexists(runs / f"measure-{number}"):
        number += 1
    folder = runs / f"measure-{number}"
    folder.mkdir(parents=True)
    return folder / "measure.png"


@pytest.mark.parametrize("what", REFUSED)
async def test_a_page_gets_nothing_but_a_regular_picture_in_the_folder_of_a_run(
    window: WindowProcess, picture: Path, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(picture.parent)
    make, problem = REFUSED[what]
    make(picture)

    async with (
        Browser(window.url) as browser,
        browser.session.get(f"/api/runs/{picture.parent.name}/plot.png") as response,
    ):
        body = await response.read()
        assert response.status == 409
        assert problem.replace("measure-1", picture.parent.name) in body.decode()
        assert SECRET not in body


async def test_a_picture_is_drawn_when_asked_for_and_again_if_the_run_has_changed(
    window: WindowProcess,
) -> None:
    folder = window.state.parent / "runs" / "drawn-later"
    words = ("measure", "swing", "--on", "simulation", "--for", "21", "--folder", str(folder))
    assert fishctl(*words).returncode == 0
    async with Browser(window.url) as browser:

        async def picture() -> bytes:
            async with browser.session.get("/api/runs/drawn-later/plot.png") as response:
                assert (response.status, response.content_type) == (200, "image/png")
                return await response.read()

        measured = await picture()
        assert measured.startswith(b"\x89PNG")
        assert await picture() == measured
        (folder / "result.json").unlink()
        assert await picture() != measured
    assert not list(folder.glob("*.png"))


async def test_a_picture_of_the_largest_size_is_served_whole_to_each_who_asks_at_once(
    window: WindowProcess, picture: Path
) -> None:
    write_sparse(picture, MAX_PICTURE_BYTES)
    before = peak_memory(window)

    async with Browser(window.url) as browser:
        path = f"/api/runs/{picture.parent.name}/plot.png"
        responses = [await browser.session.get(path) for _ in range(12)]
        for response in responses:
            assert (response.status, response.content_type) == (200, "image/png")
            size = 0
            async for chunk in response.content.iter_any():
                size += len(chunk)
            assert size == response.content_length == MAX_PICTURE_BYTES
        response = await browser.session.head(path)
        assert (response.status, response.content_length) == (200, MAX_PICTURE_BYTES)
    assert peak_memory(window) - before < MAX_PICTURE_BYTES


def peak_memory(window: WindowProcess) -> int:
    """Return the largest resident size that a window has had [bytes]."""
    status = Path(f"/proc/{window.pid}/status").read_text()
    return 1024 * int(status.partition("VmHWM:")[2].split()[0])
