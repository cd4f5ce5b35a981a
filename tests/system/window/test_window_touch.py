"""The page in the hands of a person with a phone: an emergency stop while much else goes on."""

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import expect
from rigs.browser import needs_browser, shared_browser
from rigs.live_page import PHONE, RESOLVED, go, live_page
from rigs.processes import PATIENCE, Daemon, wait_until
from rigs.window_attacks import Target
from rigs.window_process import WindowProcess, running_window

from fishd.lab.experiment import Header, open_experiment

pytestmark = needs_browser

NEVER_DRAWS = """
import asyncio
from fishd.window import downloads, runs
downloads.STALL_TIMEOUT_S = 1e4
async def call(words, folder):
    await asyncio.Event().wait()
runs.call = call
"""
"""Code of a window whose pictures are never complete, and that waits for a slow browser."""
DOWNLOAD_BYTES = 100 * 2**20


@pytest.fixture(autouse=True)
def browser() -> Iterator[None]:
    with shared_browser(RESOLVED):
        yield


@pytest.fixture
def drawing_window(daemon: Daemon, tmp_path: Path) -> Iterator[WindowProcess]:
    """Yield a window with an experiment and a large recording, whose pictures never end."""
    folder = tmp_path / "runs"
    folder.mkdir()
    with open_experiment(folder / "swept", Header(kind="sweep", on="simulation")) as experiment:
        experiment.open_table(["frequency", "thrust"]).add({"frequency": 1.5, "thrust": 0.02})
    with (folder / "large.mcap").open("wb") as file:
        file.truncate(DOWNLOAD_BYTES)
    with running_window(tmp_path, fish=daemon.endpoint, changes=NEVER_DRAWS) as window:
        yield window


def test_a_finger_stops_the_fish_while_a_download_a_picture_and_a_queue_go_on(
    drawing_window: WindowProcess, daemon: Daemon
) -> None:
    window = drawing_window
    here = Target("127.0.0.1", window.port)
    with live_page(window.url, **PHONE) as (page, complaints):
        go(page, "experiments")
        page.get_by_role("button", name="Add to queue").tap()
        expect(page.locator(".queued")).to_have_count(1)
        page.get_by_role("button", name="Start queue").tap()
        expect(page.locator("#mode")).to_have_text("running")
        go(page, "runs")
        page.get_by_role("button", name="Open swept").tap()
        expect(page.get_by_text("It is being drawn")).to_be_visible()
        with socket.create_connection((here.address, here.port), PATIENCE) as download:
            download.sendall(here.request("GET", "/api/runs/large.mcap/download/recording.mcap"))
            size = len(download.recv(1))
            page.locator("#estop").tap()
            wait_until(lambda: daemon.status().mode == "estop")
            expect(page.locator("#estop-ms")).to_contain_text("ms")
            expect(page.locator("#clear-fault")).to_be_in_viewport(ratio=1)
            expect(page.get_by_text("It is being drawn")).to_be_visible()
            while size < DOWNLOAD_BYTES and (part := download.recv(2**16)):
                size += len(part)
            assert size >= DOWNLOAD_BYTES  # it goes on
        page.locator("#clear-fault").tap()
        expect(page.locator("#mode")).to_have_text("idle")
        go(page, "live")
        expect(page.locator("#queue-line")).to_contain_text("Queue: paused, 1 in it.")
        assert complaints == []
