"""The page warns before the press: an E-stop that may not arrive turns the header amber."""

import signal
from collections.abc import Iterator
from importlib import resources
from pathlib import Path

import pytest
from playwright.sync_api import expect
from rigs.browser import needs_browser, open_page, shared_browser
from rigs.processes import PATIENCE, Daemon
from rigs.relay import relayed
from rigs.window_process import running_window

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
        expect(page.locator("#unreachable")).to_contain_text(
            "fishd has not answered at its control"
        )
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
        relay.speak_again()
        expect(page.locator("body.unreachable")).to_have_count(0)
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
