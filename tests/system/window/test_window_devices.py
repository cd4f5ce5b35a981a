"""Devices of the network: pairing, scopes, and revocation that closes their pages."""

import json
import re
import stat
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from rigs.processes import Daemon, fishctl, one_line
from rigs.window_process import (
    NETWORK_HOST,
    Browser,
    WindowProcess,
    open_page,
    running_window,
)

from fishd.window import devices
from fishd.window.devices import DeviceError, Devices

PARTS = "computer", "disk", "settings", "camera", "log"
"""What a page reads about a fish and its computer."""


def token_of(link: str) -> str:
    """Return the token in a link that pairs."""
    return link.rpartition("=")[2]


@asynccontextmanager
async def paired(window: WindowProcess, scope: str, name: str) -> AsyncIterator[Browser]:
    """Yield the browser of a paired device in the network."""
    async with Browser(window.url, NETWORK_HOST) as browser:
        body = {"token": token_of(window.invite(scope)), "name": name}
        session = await browser.post("/api/pair", body)
        assert (session["device"], session["scope"], session["loopback"]) == (name, scope, False)
        yield browser


async def refuse_page(browser: Browser, path: str = "/live") -> int:
    """Return the status with which a page is refused."""
    with pytest.raises(aiohttp.WSServerHandshakeError) as refusal:
        async with browser.session.ws_connect(path):
            pass
    return refusal.value.status


async def test_a_device_that_is_not_paired_gets_only_the_page(window: WindowProcess) -> None:
    async with Browser(window.url, NETWORK_HOST) as browser:
        session = await browser.get("/api/session")
        assert (session["paired"], session["scope"], session["device"]) == (False, None, None)
        about = (f"fish/fish/about/{part}" for part in PARTS)
        for path in (
            *("fish", "fish/fish/policies", "fish/fish/queue", "forms", "jobs", "runs"),
            *about,
        ):
            assert await browser.refusal(f"/api/{path}") == (401, "not-paired")
        for path in ("estop", "drive", "release", "request", "queue", "doctor"):
            assert await browser.refusal(f"/api/fish/fish/{path}", {}) == (401, "not-paired")
        assert await browser.refusal("/api/jobs", {}) == (401, "not-paired")
        assert await refuse_page(browser) == await refuse_page(browser, "/camera") == 401


async def test_a_token_pairs_one_device_and_no_second_one(window: WindowProcess) -> None:
    token = token_of(window.invite("watch"))
    async with (
        Browser(window.url, NETWORK_HOST) as first,
        Browser(window.url, NETWORK_HOST) as second,
    ):
        async with first.session.post("/api/pair", json={"token": token, "name": "A"}) as answer:
            cookie = answer.headers["Set-Cookie"]
            assert answer.status == 200
        for part in ("HttpOnly", "SameSite=Strict", "Max-Age=31536000", "Path=/"):
            assert part in cookie
        assert (await first.get("/api/session"))["scope"] == "watch"
        assert await second.refusal("/api/pair", {"token": token}) == (403, "device")
        assert await second.refusal("/api/pair", {"token": "x" * 22}) == (403, "device")
        await first.post("/api/unpair")
        assert not (await first.get("/api/session"))["paired"]


async def test_a_device_that_may_watch_sees_the_fish_stops_it_and_nothing_more(
    window: WindowProcess,
) -> None:
    async with paired(window, "watch", "wall") as browser, open_page(browser) as page:
        assert page.hello["session"]["scope"] == "watch"
        await page.until("ticks")
        for what in ("drive", "release", "request", "queue"):
            assert await page.refusal(what) == (403, "only-watch")
        assert (await browser.get("/api/fish/fish/queue"))["state"] == "empty"
        assert await page.refusal("/api/jobs") == (403, "only-watch")
        body = {"fish": "fish", "kind": "measure", "options": {"controller": "square"}}
        checked = await page.post("/api/jobs/check", body)
        assert (checked["problem"], checked["plan"]) == ("", None)  # it starts no process
        assert "measure" in [form["kind"] for form in await browser.get("/api/forms")]
        for part in PARTS:
            await browser.get(f"/api/fish/fish/about/{part}")
        assert await page.post("doctor")
        assert (await page.post("estop"))["way"] == "control"
    async with Browser(window.url) as browser, open_page(browser) as page:
        await page.drive()
        await page.request("clear-fault")


async def test_a_paired_device_drives(window: WindowProcess) -> None:
    async with paired(window, "drive", "tablet") as browser, open_page(browser) as page:
        await page.swim()
        status = await page.until("status", lambda status: status["lease"])
        assert status["lease"]["name"] == "window: tablet"
        await page.request("stop")


async def test_a_revoked_device_loses_its_page_and_the_fish_stops(window: WindowProcess) -> None:
    async with Browser(window.url) as here, open_page(here) as watcher:
        async with paired(window, "drive", "stolen") as browser, open_page(browser) as page:
            await page.swim()
            removed = window.ask("revoke", "stolen")
            assert removed == "stolen is no longer paired; what it drives and its jobs end\n"
            while (await page.sock.receive()).type is aiohttp.WSMsgType.TEXT:
                pass
            assert page.sock.closed
            assert await refuse_page(browser) == 401
            assert await browser.refusal("/api/fish/fish/estop", {}) == (401, "not-paired")
        await watcher.until_at_rest()


async def test_the_devices_are_listed_without_any_secret(window: WindowProcess) -> None:
    async with paired(window, "watch", "listed"):
        text = window.ask("devices")
        assert re.search(r"(?m)^\w{8}  watch  seen \d{4}-\d\d-\d\d \d\d h  listed$", text)
        listed: list[dict[str, Any]] = json.loads(window.ask("devices", "--json"))
        assert listed[-1].keys() == {"id", "name", "scope", "paired", "seen"}
    file = window.state / "devices.json"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stat.S_IMODE(window.state.stat().st_mode) == 0o700


def test_a_page_for_this_machine_only_has_no_link_for_other_devices(tmp_path: Path) -> None:
    done = fishctl("window", "pair", "--state", str(tmp_path))
    assert "which no other device reaches: start it with --listen 0.0.0.0:8880" in one_line(done)
    done = fishctl("window", "pair", "--state", str(tmp_path), "--listen", "192.0.2.9:8880")
    assert re.search(r"to drive: http://192\.0\.2\.9:8880/#pair=[\w-]{22}\n", done.stdout)
    done = fishctl("window", "revoke", "--state", str(tmp_path), "tablet")
    assert "no device is named 'tablet'; paired: there is none" in one_line(done)


def test_a_token_expires(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paired = Devices(tmp_path)
    token = paired.invite("watch", seconds=-1.0)
    with pytest.raises(DeviceError, match="was used already, or has expired"):
        paired.pair(token, "late")
    monkeypatch.setattr(devices, "MAX_DEVICES", 1)
    paired.pair(paired.invite("watch"), "first")
    with pytest.raises(DeviceError, match="1 devices are paired"):
        paired.pair(paired.invite("watch"), "second")


@pytest.mark.parametrize("seconds", [-86400.0, 86400.0])
def test_a_step_of_the_clock_neither_ends_nor_revives_a_link(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seconds: float
) -> None:
    paired, real = Devices(tmp_path), time.time
    valid, expired = paired.invite("watch"), paired.invite("watch", seconds=0.0)
    monkeypatch.setattr(time, "time", lambda: real() + seconds)
    with pytest.raises(DeviceError, match="was used already, or has expired"):
        Devices(tmp_path).pair(expired, "late")
    assert Devices(tmp_path).pair(valid, "in time")[0].scope == "watch"


def test_a_link_from_before_the_machine_was_started_again_has_expired(tmp_path: Path) -> None:
    paired = Devices(tmp_path)
    token = paired.invite("watch")
    file = tmp_path / "devices.json"
    content = json.loads(file.read_text())
    content["invitations"][0]["boot"] = "an earlier one"
    file.write_text(json.dumps(content))
    with pytest.raises(DeviceError, match="was used already, or has expired"):
        paired.pair(token, "late")


def test_a_state_folder_that_others_may_write_is_refused_as_they_could_pair_devices(
    tmp_path: Path,
) -> None:
    state = tmp_path / "window"
    state.mkdir()
    state.chmod(0o770)
    problem = f"{state}: other users may change it (mode 770), and so pair devices; run 'chmod go-w"
    assert problem in one_line(fishctl("window", "devices", "--state", str(state)))
    with WindowProcess(tmp_path) as window:
        status, _, errors = window.finish()
    assert (status, errors.count("\n")) == (1, 1)
    assert problem in errors


def test_devices_of_one_name_are_told_apart_and_names_are_printable(tmp_path: Path) -> None:
    paired = Devices(tmp_path)
    names = [
        paired.pair(paired.invite("watch"), name)[0].name for name in ("a", "a", "\x1b[2J", "")
    ]
    assert names == ["a", "a 2", "?[2J", "device"]


def test_a_damaged_file_pairs_nothing_and_says_what_to_do(tmp_path: Path) -> None:
    paired = Devices(tmp_path)
    paired.pair(paired.invite("drive"), "tablet")
    (tmp_path / "devices.json").write_text("{")
    for change in (paired.all, lambda: paired.invite("watch"), lambda: paired.revoke("tablet")):
        with pytest.raises(DeviceError, match=r"devices\.json: .*; replace it by"):
            change()
    (tmp_path / "devices.copy.json").replace(tmp_path / "devices.json")
    assert [device.name for device in paired.all()] == ["tablet"]


def test_the_copy_of_the_file_revives_no_revoked_device(tmp_path: Path) -> None:
    paired = Devices(tmp_path)
    for name in ("stolen", "tablet"):
        paired.pair(paired.invite("drive"), name)
    copy = tmp_path / "devices.copy.json"
    (tmp_path / "devices.copy.new").mkdir()  # the copy can be removed, but not written
    paired.revoke("stolen")
    assert not copy.exists()
    copy.mkdir()  # nor removed
    with pytest.raises(DeviceError, match=r"neither written nor removed: .*; the device stays"):
        paired.revoke("tablet")
    assert [device.name for device in Devices(tmp_path).all()] == ["tablet"]


def test_the_file_is_written_after_its_copy(tmp_path: Path) -> None:
    paired = Devices(tmp_path)
    paired.pair(paired.invite("drive"), "stolen")
    (tmp_path / "devices.new").mkdir()  # as if the machine lost its power between the two
    with pytest.raises(OSError, match=r"devices\.new"):
        paired.revoke("stolen")
    assert paired.read_copy() == ()


@pytest.mark.parametrize("path", ["/foxglove", "/camera"])
async def test_a_revoked_device_loses_its_other_views_too(window: WindowProcess, path: str) -> None:
    async with paired(window, "watch", "viewer") as browser:
        options = {"protocols": ["foxglove.sdk.v1"]}
        async with browser.session.ws_connect(path, **options) as sock:
            await sock.receive_str()
            window.ask("revoke", "viewer")
            while not sock.closed:
                await sock.receive()


async def test_with_pair_all_a_browser_on_this_machine_needs_pairing(
    daemon: Daemon, tmp_path: Path
) -> None:
    with running_window(tmp_path, settings="pair_all: true", fish=daemon.endpoint) as window:
        async with Browser(window.url) as browser:
            assert await browser.refusal("/api/fish") == (401, "not-paired")
            assert await browser.refusal("/api/fish/fish/estop", {}) == (401, "not-paired")
            session = await browser.post("/api/pair", {"token": token_of(window.invite("drive"))})
            assert (session["scope"], session["loopback"]) == ("drive", False)
            assert await browser.get("/api/fish")
