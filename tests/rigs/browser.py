"""Real browser that opens a page."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import pytest
from playwright.sync_api import Page, sync_playwright

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")


@contextmanager
def open_page(url: str, *options: str, **settings: Any) -> Iterator[tuple[Page, list[str]]]:
    """Yield the page, and its problems: errors, and requests that leave this machine.

    options: further ones of Chromium's command line
    settings: those of a page of playwright, such as `color_scheme`
    """
    complaints: list[str] = []
    with sync_playwright() as playwright:
        arguments = ["--no-sandbox", "--disable-gpu", *options]
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
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
            browser.close()
