"""Real browser that opens a page."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
UNUSED_FEATURES = (
    # Further processes of each new page, with half of the processor time of all pages.
    "SpareRendererForSitePerProcess", "WebUIOmniboxAimPopup", "WebUIOmniboxPopup",
    # Of the ones that playwright disables, those that matter here; the last option alone counts.
    "DestroyProfileOnBrowserClose", "HttpsFirstBalancedModeAutoEnable", "HttpsUpgrades",
    "MediaRouter", "OptimizationHints", "PaintHolding",
)  # fmt: skip
"""Features of Chromium that are switched off."""
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")


_SHARED: list[Browser] = []


@contextmanager
def shared_browser(*options: str) -> Iterator[Browser]:
    """Let `open_page` open its pages in one browser; inside, asyncio cannot start a loop.

    options: further ones of Chromium's command line
    """
    with sync_playwright() as playwright:
        without = f"--disable-features={','.join(UNUSED_FEATURES)}"
        arguments = ["--no-sandbox", "--disable-gpu", without, *options]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        _SHARED.append(browser)
        try:
            yield browser
        finally:
            _SHARED.remove(browser)
            browser.close()


@contextmanager
def open_page(url: str, **settings: Any) -> Iterator[tuple[Page, list[str]]]:
    """Yield the page, and its problems: errors, and requests that leave this machine.

    It shares no cookie, storage or cache with other pages.

    settings: those of a page of playwright, such as `color_scheme`
    """
    complaints: list[str] = []
    with nullcontext(_SHARED[-1]) if _SHARED else shared_browser() as browser:
        page = browser.new_page(**{"viewport": {"width": 1100, "height": 760}, **settings})
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on(
            "request",
            lambda request: (
                None if request.url.startswith((url, "data:", "blob:"))
                else complaints.append(request.url)
            ),
        )  # fmt: skip
        page.on(
            "websocket",
            lambda socket: (
                None if urlsplit(socket.url).netloc == urlsplit(url).netloc
                else complaints.append(socket.url)
            ),
        )  # fmt: skip
        try:
            page.goto(url)
            yield page, complaints
        finally:
            for context in browser.contexts:
                context.close()
