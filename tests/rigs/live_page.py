"""The page of a window in a true browser, once it shows ticks."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from playwright.sync_api import Page, expect

from rigs.browser import open_page
from rigs.processes import PATIENCE
from rigs.window_process import NETWORK_HOST

RESOLVED = f"--host-resolver-rules=MAP {NETWORK_HOST} 127.0.0.1"
"""Option of the browser, with which it opens the link of an invitation."""

PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}
"""Settings of a page on a phone."""

expect.set_options(timeout=PATIENCE * 1e3)


@contextmanager
def live_page(url: str, **settings: Any) -> Iterator[tuple[Page, list[str]]]:
    """Open the page, and wait until it shows ticks; see `open_page`."""
    with open_page(f"{url}/", **settings) as (page, complaints):
        expect(page.locator("#connection")).to_contain_text("live")
        yield page, complaints


def name_device(page: Page, name: str) -> None:
    """Give the name for which a page that was opened by a link asks."""
    page.get_by_label("Name of this device").fill(name)
    page.get_by_role("button", name="Pair").click()


def go(page: Page, place: str) -> None:
    """Show a part of the page: `live`, `experiments`, `runs` or `fish`."""
    page.click(f"#places a[href='#{place}']")
    expect(page.locator(f"main[data-place={place}]")).to_be_visible()
    if place == "fish":
        expect(page.locator("#configuration table")).to_be_visible()
        expect(page.locator("#about").get_by_text("Loading …")).to_have_count(0)


def swim(page: Page, controller: str = "swing") -> None:
    """Start a controller, and wait until the fish swims."""
    page.select_option("#controller", controller)
    start(page)
    expect(page.locator("#mode")).to_have_text("running")


def start(page: Page) -> None:
    """Start the controller that is chosen; fishd must accept it."""
    with page.expect_response("**/request", timeout=PATIENCE * 1e3) as response:
        page.click("#start")
    assert response.value.ok, response.value.text()
