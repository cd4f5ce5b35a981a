"""Requests of the page: what each does to the true fish, and what it answers."""

import gzip
import hashlib
import json
from importlib import resources
from typing import Any

import pytest
from rigs.processes import Daemon
from rigs.window_process import Browser, WindowProcess, open_page

from fishd.core.signals import Tick


async def test_a_page_begins_with_all_that_it_needs(new_window: WindowProcess) -> None:
    async with Browser(new_window.url) as browser, open_page(browser) as page:
        hello = page.hello
        assert hello["fish"] == ["fish"]
        assert hello["session"]["scope"] == "drive"
        assert hello["session"]["loopback"]
        assert (hello["driver"], hello["you_drive"]) == (None, False)
        assert hello["status"]["robot"] == "simulated"
        square = next(info for info in hello["controllers"] if info["name"] == "square")
        frequency = next(field for field in square["parameters"] if field["name"] == "frequency")
        assert (frequency["low"], frequency["high"], frequency["unit"]) == (0.001, 10, "Hz")
        assert frequency["step"] == 0.05


async def test_ticks_come_in_order_and_continue_the_history(window: WindowProcess) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.until("ticks")
        await page.sock.close()
        async with open_page(browser) as later:
            seqs: list[int] = []
            kind, payload = await later.message()
            while kind != "ticks":
                if kind == "history":
                    assert set(payload) <= set(Tick.__struct_fields__)
                    sizes = {len(payload[name]) for name in ("seq", "t", "fx", "phi_c")}
                    assert sizes == {len(payload["seq"])}
                    seqs += payload["seq"]
                kind, payload = await later.message()
            for _ in range(5):
                seqs += [tick["seq"] for tick in payload]
                payload = await later.until("ticks")
            assert seqs == list(range(seqs[0], seqs[-1] + 1))


async def test_the_driver_swims_tunes_marks_tares_and_stops_the_fish(
    window: WindowProcess, daemon: Daemon
) -> None:
    daemon.wait_until_still()

    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.drive()
        tared = await page.request("tare", seconds=0.2)
        assert tared["force"]["x0"] != 0.0
        state = await page.request("set-controller", name="square", parameters={"frequency": 1.5})
        assert (state["mode"], state["controller"]) == ("running", "square")
        state = await page.request("set-parameters", parameters={"frequency": 2})
        assert state["parameters"]["frequency"] == 2.0
        await page.request("mark", text="water changed")
        event = await page.until("event", lambda event: event["kind"] == "mark")
        assert event["message"] == "water changed"
        state = await page.request("stop")
        assert state["mode"] == "idle"
        await page.until_at_rest()


async def test_an_emergency_stop_needs_no_driver_and_is_cleared(
    window: WindowProcess, daemon: Daemon
) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.swim()
        async with Browser(window.url) as other:
            result = await other.post("/api/fish/fish/estop")
        assert result["way"] == "control"
        assert result["server_ms"] > 0.0
        assert daemon.status().reason.code == "estop"  # type: ignore[union-attr]
        assert (await page.request("clear-fault"))["mode"] == "idle"


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [
        ({"op": "swim"}, 400, "unknown-op"),
        ({"op": "estop"}, 400, "unknown-op"),
        ({"op": "stop", "args": {"now": 1}}, 400, "bad-arguments"),
        ({"op": "set-controller", "args": {"name": 3}}, 400, "bad-arguments"),
        ({"op": "set-controller", "args": {"name": "swin"}}, 409, "unknown-controller"),
        ({"op": "set-parameters", "args": {"parameters": {"C": 1}}}, 409, "not-running"),
        ({"op": "tare", "args": {"seconds": 1e9}}, 400, "bad-arguments"),
        ({"op": "mark", "args": {"text": "x" * 2000}}, 400, "bad-arguments"),
        ({}, 400, "bad-arguments"),
        ([], 400, "bad-arguments"),
    ],
)
async def test_a_wrong_request_is_answered_with_its_mistake(
    window: WindowProcess, body: Any, status: int, code: str
) -> None:
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.drive()
        if body == []:
            async with browser.session.post(
                "/api/fish/fish/request", data=b"[]",
                headers={"X-Client": page.hello["client"], "Content-Type": "application/json"},
            ) as response:  # fmt: skip
                answer = json.loads(await response.read())
                assert (response.status, answer["error"]["code"]) == (status, code)
        else:
            assert await page.refusal("request", body) == (status, code)


@pytest.mark.parametrize(
    ("path", "status", "code"),
    [
        ("/api/fish/fish/drive", 405, "method-not-allowed"),
        ("/api/none", 404, "not-found"),
        ("/api/runs/..%2f..%2fetc/plot.png", 409, "job"),
        (f"/api/runs/{'a' * 300}/plot.png", 409, "job"),
    ],
)
async def test_wrong_paths_get_json(
    window: WindowProcess, path: str, status: int, code: str
) -> None:
    async with Browser(window.url) as browser:
        assert await browser.refusal(path) == (status, code)


async def test_a_request_from_no_open_page_or_not_in_json_is_refused(window: WindowProcess) -> None:
    async with Browser(window.url) as browser:
        assert await browser.refusal("/api/fish/fish/drive", {}) == (409, "no-page")
        wrong = {"Content-Type": "text/plain", "X-Client": "x"}
        async with browser.session.post(
            "/api/fish/fish/drive", data=b"{}", headers=wrong
        ) as response:
            assert response.status == 415
        async with browser.session.post(
            "/api/pair", data=bytes(20_000), headers={"Content-Type": "application/json"}
        ) as response:
            assert response.status == 413


async def test_the_files_of_the_page_are_compressed_once_and_sent_again_only_if_changed(
    window: WindowProcess,
) -> None:
    name = "vendor/uPlot-1.6.32.min.js"
    content = resources.files("fishd.window").joinpath("page", name).read_bytes()

    async with Browser(window.url) as browser:
        headers = {"Accept-Encoding": "gzip"}
        session = browser.session
        async with session.get(f"/{name}", headers=headers) as response:
            assert response.headers["Content-Encoding"] == "gzip"
            assert "default-src 'none'" in response.headers["Content-Security-Policy"]
            assert await response.read() == content
            tag = response.headers["ETag"]
        async with session.get(f"/{name}", headers={"If-None-Match": tag}) as response:
            assert (response.status, await response.read()) == (304, b"")
    assert len(gzip.compress(content)) < 25_000


def test_the_libraries_of_the_page_are_those_that_were_fetched() -> None:
    vendor = resources.files("fishd.window").joinpath("page", "vendor")
    manifest = json.loads(vendor.joinpath("manifest.json").read_bytes())
    files = {entry["file"]: entry for package in manifest["packages"] for entry in package["files"]}
    assert {path.name for path in vendor.iterdir()} == {*files, "manifest.json"}
    for name, entry in files.items():
        assert hashlib.sha256(vendor.joinpath(name).read_bytes()).hexdigest() == entry["sha256"]
    assert all(package["integrity"].startswith("sha512-") for package in manifest["packages"])
