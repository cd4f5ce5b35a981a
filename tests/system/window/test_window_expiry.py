"""Links and devices that expire: they are dropped then, whatever the wall clock shows."""

import json
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import aiohttp
import msgspec
import pytest
from rigs.processes import Daemon, wait_until
from rigs.window_process import (
    NETWORK_HOST,
    Browser,
    WindowProcess,
    open_page,
    running_window,
)

from fishd.window import devices, expiry
from fishd.window.devices import DeviceError, Devices

YEAR_S = 365 * 86400.0
STEPPED = """
import signal, time
from fishd.window import devices, expiry
real, steps = time.time, [0.0, -86400.0]
time.time = lambda: real() + steps[0]
devices.is_synchronised = expiry.is_synchronised = lambda: True
signal.signal(signal.SIGUSR1, lambda *_: steps.reverse())
signal.signal(signal.SIGUSR2, lambda *_: setattr(devices, "DEVICE_S", 0.0))
"""
"""Code of a window: SIGUSR1 sets its clock back by a day, later right again; SIGUSR2 lets its
devices expire."""
Step = Callable[[float], None]


@pytest.fixture
def step(monkeypatch: pytest.MonkeyPatch) -> Step:
    """Return a function that sets the wall clock of this process forward [s]."""
    real = time.time

    def step(seconds: float) -> None:
        monkeypatch.setattr(time, "time", lambda: real() + seconds)

    return step


@pytest.fixture(autouse=True)
def synchronise(monkeypatch: pytest.MonkeyPatch) -> Callable[[bool], None]:
    """Let no time server keep the clock; return a function that changes that."""

    def synchronise(is_synchronised: bool) -> None:
        for module in (expiry, devices):
            monkeypatch.setattr(module, "is_synchronised", lambda: is_synchronised)

    synchronise(False)
    return synchronise


@pytest.fixture
def stepped_window(daemon: Daemon, tmp_path: Path) -> Iterator[WindowProcess]:
    """Yield a window whose clock can be set back."""
    with running_window(tmp_path, changes=STEPPED, fish=daemon.endpoint) as process:
        yield process


def content_of(folder: Path) -> dict[str, Any]:
    """Return the content of the file of devices."""
    content: dict[str, Any] = json.loads((folder / "devices.json").read_text())
    return content


async def test_a_link_that_has_expired_leaves_the_file_and_pairs_nothing_after_a_step_back(
    stepped_window: WindowProcess,
) -> None:
    token = Devices(stepped_window.state).invite("drive", seconds=0.5)
    stepped_window.process.send_signal(signal.SIGUSR1)
    wait_until(lambda: content_of(stepped_window.state)["invitations"] == [])

    async with Browser(stepped_window.url, NETWORK_HOST) as browser:
        assert await browser.refusal("/api/pair", {"token": token}) == (403, "device")


@pytest.mark.parametrize("seconds", [-86400.0, 86400.0])
def test_a_step_of_the_clock_neither_ends_nor_revives_a_link(
    tmp_path: Path, step: Step, seconds: float
) -> None:
    paired = Devices(tmp_path)
    valid, expired = paired.invite("watch"), paired.invite("watch", seconds=0.0)
    step(seconds)
    with pytest.raises(DeviceError, match="was used already, or has expired"):
        Devices(tmp_path).pair(expired, "late")
    assert Devices(tmp_path).pair(valid, "in time")[0].scope == "watch"


def test_a_link_from_before_the_machine_was_started_again_has_expired(tmp_path: Path) -> None:
    paired = Devices(tmp_path)
    token = paired.invite("watch")
    content = content_of(tmp_path)
    content["invitations"][0]["boot"] = "an earlier one"
    (tmp_path / "devices.json").write_bytes(msgspec.json.encode(content))
    with pytest.raises(DeviceError, match="was used already, or has expired"):
        paired.pair(token, "late")
    assert paired.all() == ()
    assert content_of(tmp_path)["invitations"] == []


async def test_a_device_that_has_expired_loses_its_page_its_fish_and_its_place_in_the_file(
    stepped_window: WindowProcess, daemon: Daemon
) -> None:
    token = Devices(stepped_window.state).invite("drive")
    async with Browser(stepped_window.url, NETWORK_HOST) as browser:
        await browser.post("/api/pair", {"token": token, "name": "tablet"})
        async with open_page(browser) as page:
            await page.swim()
            stepped_window.process.send_signal(signal.SIGUSR1)
            stepped_window.process.send_signal(signal.SIGUSR2)
            while (await page.sock.receive()).type is aiohttp.WSMsgType.TEXT:
                pass
        assert await browser.refusal("/api/fish/fish/estop", {}) == (401, "not-paired")
    assert len(content_of(stepped_window.state)["devices"]) == 1  # this clock may be wrong
    stepped_window.process.send_signal(signal.SIGUSR1)
    wait_until(lambda: content_of(stepped_window.state)["devices"] == [])
    wait_until(lambda: daemon.status().mode == "idle")


def test_a_step_of_the_clock_neither_ends_nor_prolongs_the_access_of_a_device(
    tmp_path: Path,
    step: Step,
    synchronise: Callable[[bool], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    paired = Devices(tmp_path)
    device, _ = paired.pair(paired.invite("drive"), "tablet")
    step(2.0 * YEAR_S)
    assert paired.all() == (device,)
    assert Devices(tmp_path).list_stored() == (device,)  # as 'fishctl window devices' shows it
    step(-2.0 * YEAR_S)
    assert paired.all() == (device,)
    step(0.0)
    synchronise(True)
    monkeypatch.setattr(devices, "DEVICE_S", 0.0)
    assert paired.all() == ()
    assert content_of(tmp_path)["devices"] == []


def test_a_wrong_clock_at_the_start_removes_no_device_from_the_file(
    tmp_path: Path, step: Step, synchronise: Callable[[bool], None]
) -> None:
    paired = Devices(tmp_path)
    device, _ = paired.pair(paired.invite("drive"), "tablet")
    step(2.0 * YEAR_S)
    wrong = Devices(tmp_path)
    assert wrong.all() == ()
    step(0.0)
    synchronise(True)
    assert wrong.all() == ()  # a step back revives nothing
    assert Devices(tmp_path).all() == (device,)


def test_a_clock_that_was_in_the_past_at_the_start_follows_a_time_server_but_no_hand(
    tmp_path: Path,
    step: Step,
    synchronise: Callable[[bool], None],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(expiry, "LOOK_PERIOD_S", 0.0)
    step(-2.0 * YEAR_S)
    paired = Devices(tmp_path)
    paired.pair(paired.invite("drive"), "tablet")
    step(0.0)
    assert len(paired.all()) == 1
    synchronise(True)
    assert paired.all() == ()
    assert content_of(tmp_path)["devices"] == []


def test_a_window_that_starts_with_a_clock_that_was_set_back_does_not_revive_a_device(
    tmp_path: Path, step: Step
) -> None:
    paired = Devices(tmp_path)
    paired.pair(paired.invite("drive"), "used to the end")
    content = content_of(tmp_path)
    (device,) = content["devices"]
    device["seen"] = device["paired"] + YEAR_S
    (tmp_path / "devices.json").write_bytes(msgspec.json.encode(content))
    step(-10.0)
    assert Devices(tmp_path).all() == ()


def test_what_has_expired_is_refused_where_the_file_cannot_be_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, synchronise: Callable[[bool], None]
) -> None:
    synchronise(True)
    paired = Devices(tmp_path)
    paired.pair(paired.invite("drive"), "tablet")
    monkeypatch.setattr(devices, "DEVICE_S", 0.0)
    (tmp_path / "devices.new").mkdir()  # no file can be written in its place
    assert paired.all() == ()
    (tmp_path / "devices.new").rmdir()
    monkeypatch.setattr(devices, "DROP_RETRY_S", 0.0)
    assert Devices(tmp_path).all() == ()
    assert content_of(tmp_path)["devices"] == []
