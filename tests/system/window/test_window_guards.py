"""Attempts of other web pages: DNS rebinding, other origins, forms; none changes anything."""

import asyncio
from typing import Any

import aiohttp
import pytest
from rigs.processes import Daemon
from rigs.window_process import Browser, WindowProcess, open_page

from fishd.window.access import is_loopback

REBOUND = [
    "evil.example", "127.attacker.example", "127.0.0.1.attacker.example", "localhost.evil.example",
    "evil.example@127.0.0.1", "127.0.0.1@evil.example", "localhost:evil", "[::1", "127.0.0.1.",
    "0x7f.evil", "fish.example.evil", "evil.example#127.0.0.1", "evil.example/127.0.0.1", "",
]  # fmt: skip
"""Host names that resolve, or look as if they did, to this machine."""
FOREIGN = [
    "http://evil.example", "null", "", "http://127.0.0.1", "http://127.0.0.1:1",
    "http://localhost:{port}", "http://127.attacker.example:{port}", "http://127.0.0.1:{port}.evil.example",
    "http://evil.example:{port}", "http://127.0.0.1:{port}@evil.example", "file://",
    "http://evil.example#127.0.0.1:{port}",
]  # fmt: skip
"""Origins of other pages."""
CHANGES = [
    ("/api/pair", {"token": "x"}),
    ("/api/unpair", {}),
    ("/api/fish/fish/estop", {}),
    ("/api/fish/fish/drive", {"take": True}),
    ("/api/fish/fish/release", {}),
    ("/api/fish/fish/request", {"op": "set-controller", "args": {"name": "square"}}),
    ("/api/fish/fish/doctor", {}),
    ("/api/fish/fish/queue", {"op": "clear"}),
    ("/api/jobs", {"fish": "fish", "kind": "record"}),
    ("/api/jobs/check", {"fish": "fish", "kind": "record"}),
    ("/api/jobs/1/stop", {}),
    ("/api/jobs/1/dismiss", {}),
    ("/api/runs/x/note", {"note": "x"}),
    ("/api/runs/x/rename", {"name": "y"}),
    ("/api/runs/x/delete", {}),
    ("/api/trash/20260101-000000/restore", {}),
    ("/api/trash/empty", {"ids": ["x"]}),
]


@pytest.mark.parametrize("host", REBOUND)
async def test_no_name_that_leads_here_but_is_not_ours_gets_anything(
    window: WindowProcess, daemon: Daemon, host: str
) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.drive()
        authority = f"{host}:{window.port}" if host else ""
        headers = {
            "Host": authority, "Origin": f"http://{authority}",
            "X-Client": page.hello["client"],
        }  # fmt: skip
        about = "/api/fish/fish/about/log"
        for path in ("/", "/api/session", "/api/fish", about, "/api/forms", "/metrics"):
            async with browser.session.get(path, headers=headers) as response:
                assert response.status == 403
        for path, body in CHANGES:
            assert await browser.refusal(path, body, headers=headers) == (403, "forbidden")
        for path in ("/live", "/camera"):
            with pytest.raises(aiohttp.WSServerHandshakeError) as refusal:
                await browser.session.ws_connect(path, headers=headers)
            assert refusal.value.status == 403
    assert daemon.status().mode == "idle"


@pytest.mark.parametrize("origin", FOREIGN)
async def test_no_page_of_another_origin_changes_or_sees_anything(
    window: WindowProcess, daemon: Daemon, origin: str
) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.drive()
        foreign = origin.format(port=window.port)
        headers = {"Origin": foreign, "X-Client": page.hello["client"]}
        for path, body in CHANGES:
            assert await browser.refusal(path, body, headers=headers) == (403, "forbidden")
        for path in ("/live", "/camera"):
            with pytest.raises(aiohttp.WSServerHandshakeError) as refusal:
                await browser.session.ws_connect(path, headers=headers)
            assert refusal.value.status == 403
    assert daemon.status().mode == "idle"


async def test_a_change_without_an_origin_and_a_form_are_refused(
    window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(window.url) as browser, aiohttp.ClientSession(window.url) as session:
        for path, body in CHANGES:
            async with session.post(path, json=body) as response:
                assert response.status == 403
        async with browser.session.post("/api/pair", data={"token": "x"}) as response:
            assert response.status == 415
    assert daemon.status().mode == "idle"


async def test_another_site_starts_no_reading_either_where_the_browser_tells(
    window: WindowProcess,
) -> None:
    async with Browser(window.url) as browser:
        for site in ("cross-site", "same-site"):
            headers = {"Sec-Fetch-Site": site}
            for path in (
                *("/api/runs", "/api/trash", "/api/results?run=x", "/api/runs/x/download/all.zip"),
                *("/api/fish/fish/queue", "/api/fish/fish/about/log", "/api/forms", "/metrics"),
                "/camera",
            ):
                refused = await browser.refusal(path, headers=headers)
                assert refused == (403, "other-origin")


FORWARDED = [
    {"X-Forwarded-For": "192.0.2.7"},
    {"Forwarded": "for=192.0.2.7"},
    {"X-Real-IP": "192.0.2.7"},
    {"Via": "1.1 proxy"},
    {"X-Forwarded-Host": "fish.example"},
]


@pytest.mark.parametrize("headers", FORWARDED, ids=lambda headers: next(iter(headers)))
async def test_a_browser_behind_a_reverse_proxy_is_not_one_of_this_machine(
    window: WindowProcess, headers: dict[str, str]
) -> None:
    async with Browser(window.url) as browser:
        for path in ("/api/fish", "/metrics"):
            assert await browser.refusal(path, headers=headers) == (401, "not-paired")
    async with Browser(window.url, "fish.example") as browser:
        assert await browser.refusal("/api/fish") == (401, "not-paired")


@pytest.mark.parametrize(
    ("peer", "host", "loopback"),
    [
        ("127.0.0.1", "127.0.0.1:8880", True), ("127.0.0.1", "localhost", True),
        ("::1", "[::1]:8880", True), ("127.8.9.1", "127.1.2.3", True),
        ("::ffff:127.0.0.1", "localhost:8880", True), ("192.0.2.7", "127.0.0.1:8880", False),
        ("127.0.0.1", "192.0.2.7:8880", False), ("127.0.0.1", "fish.example", False),
        ("127.0.0.1", "127.attacker.example", False), ("", "localhost", False),
    ],
)  # fmt: skip
def test_loopback_is_an_address_of_loopback_on_both_ends(
    peer: str, host: str, loopback: bool
) -> None:
    class Request:
        remote, headers = peer, dict[str, Any]()

    Request.host = host  # type: ignore[attr-defined]
    assert is_loopback(Request()) is loopback  # type: ignore[arg-type]


async def test_no_two_requests_are_read_from_one_that_is_smuggled(window: WindowProcess) -> None:
    smuggled = b"POST /api/fish/fish/estop HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
    both = (
        b"POST /api/session HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nContent-Length: %d\r\n"
        b"Transfer-Encoding: chunked\r\n\r\n0\r\n\r\n" % (window.port, len(smuggled))
    )
    reader, writer = await asyncio.open_connection("127.0.0.1", window.port)
    writer.write(both + smuggled)
    answer = await reader.read()
    assert answer.startswith(b"HTTP/1.0 400 ")
    assert answer.count(b"HTTP/") == 1
    writer.close()
