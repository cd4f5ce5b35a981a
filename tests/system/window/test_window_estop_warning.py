"""The page warns before the press: an E-stop that may not arrive turns the header amber."""

import shutil
import signal
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import pytest
from playwright.sync_api import expect
from rigs.browser import needs_browser, open_page, shared_browser
from rigs.processes import PATIENCE, Daemon, running, sets
from rigs.relay import relayed
from rigs.window_process import WindowProcess, running_window

pytestmark = needs_browser

AXE = resources.files("axe_playwright_python").joinpath("axe.min.js")
"""The program that looks for barriers."""
HEADER_COLOUR = "getComputedStyle(document.querySelector('header')).backgroundColor"
expect.set_options(timeout=PATIENCE * 1e3)


@pytest.fixture(scope="module", autouse=True)
def browser() -> Iterator[None]:
    """Open one browser for the pages of this module."""
    with shared_browser():
        yield


def test_the_header_is_amber_and_says_what_to_do_while_ticks_come_but_fishd_does_not_answer(
    daemon: Daemon, tmp_path: Path
) -> None:
    with (
        relayed(tmp_path / "relay", daemon.endpoint) as relay,
        running_window(tmp_path, fish=relay.endpoint) as window,
        open_page(f"{window.url}/", bypass_csp=True) as (page, complaints),
    ):
        expect(page.locator("#connection")).to_contain_text("live")
        expect(page.locator("body.unreachable")).to_have_count(0)
        before, place = page.evaluate(HEADER_COLOUR), page.locator("#estop").bounding_box()
        relay.fall_silent()
        expect(page.locator("#unreachable")).to_contain_text("fishd has not answered at any of")
        expect(page.locator("#unreachable")).to_contain_text("run fishctl estop on its computer")
        expect(page.locator("#connection")).to_contain_text("live")
        assert page.evaluate(HEADER_COLOUR) != before
        assert page.locator("#estop").bounding_box() == place
        assert page.locator("#estop").is_enabled()
        page.evaluate(AXE.read_text(encoding="utf-8"))
        for scheme in ("light", "dark"):
            page.emulate_media(color_scheme=scheme)
            found = page.evaluate("axe.run('header, #banner')")["violations"]
            assert [entry for entry in found if entry["impact"] in ("serious", "critical")] == []
        own = f"{daemon.endpoint}.estop".removeprefix("ipc://")
        (tmp_path / "relay.estop").symlink_to(own)  # an emergency stop takes it, too
        expect(page.locator("body.unreachable")).to_have_count(0)
        page.click("#estop")
        expect(page.locator("#estop-ms")).to_contain_text("ms")
        assert daemon.status().mode == "estop"
        assert complaints == []


def test_a_page_shows_that_a_fishd_which_hangs_was_stopped_without_it(
    own_daemon: Daemon, own_window: WindowProcess
) -> None:
    with open_page(f"{own_window.url}/") as (page, _):
        expect(page.locator("#mode")).to_have_text("idle")
        own_daemon.stop()
        expect(page.locator("#unreachable")).to_contain_text("may not reach the fish")
        expect(page.locator("#mode")).to_have_text("was idle")
        page.click("#estop")
        expect(page.locator("#latched")).to_contain_text("fishd did not answer; without it:")
        expect(page.locator("body.unreachable")).to_have_count(0)
        expect(page.locator("#banner")).to_contain_text("What is greyed is old")
        own_daemon.process.send_signal(signal.SIGCONT)
        expect(page.locator("#mode")).to_have_text("E-stop")
        expect(page.locator("#banner")).not_to_contain_text("What is greyed is old")


def test_a_page_says_that_no_further_client_can_connect_to_fishd_which_lets_the_fish_rest(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "sockets"
    folder.mkdir()
    with (
        running(folder, *sets("start.controller=swing")) as daemon,
        running_window(tmp_path, fish=daemon.endpoint) as window,
        open_page(f"{window.url}/") as (page, complaints),
    ):
        expect(page.locator("#mode")).to_have_text("running")
        shutil.rmtree(folder)
        folder.touch()
        banner = page.locator("#sockets")
        expect(banner).to_contain_text("Clients cannot reach the control socket")
        expect(banner).to_contain_text("fishd has let the fish rest")
        expect(banner).to_contain_text("Restart fishd, or log in again.")
        expect(page.locator("#events")).to_contain_text(
            "Limitation: clients cannot reach the control socket"
        )
        expect(page.locator("body.unreachable")).to_have_count(0)
        page.click("#estop")
        expect(page.locator("#mode")).to_have_text("E-stop")
        assert complaints == []


def test_a_window_that_hangs_turns_the_header_amber_by_the_clock_of_the_page(
    daemon: Daemon, tmp_path: Path
) -> None:
    with (
        running_window(tmp_path, fish=daemon.endpoint) as window,
        open_page(f"{window.url}/") as (page, _),
    ):
        expect(page.locator("#connection")).to_contain_text("live")
        window.stop()
        try:
            expect(page.locator("#unreachable")).to_contain_text("fishd-window has not answered")
            expect(page.locator("body.unreachable")).to_have_count(1)
        finally:
            window.process.send_signal(signal.SIGCONT)
        expect(page.locator("body.unreachable")).to_have_count(0)
