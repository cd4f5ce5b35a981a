"""An emergency stop of a page while others attack the window, its disk fails, or fishd is dead.

An attack goes on until the stop is confirmed.
"""

import asyncio
import json
import signal
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, asynccontextmanager, suppress
from pathlib import Path

import pytest
from rigs.processes import Daemon, wait_until
from rigs.window_attacks import (
    DISK_TROUBLES,
    FLOODS,
    HISTORIES,
    NETWORK_ATTACKS,
    SLOW_BODIES,
    Attack,
    Target,
    mounted,
    own_address,
    pair,
    press,
    stalled,
    unsee,
)
from rigs.window_process import Browser, WindowProcess, open_page, running_window

from common.daemon import list_children
from fishd.window.devices import Devices
from fishd.window.places import PLACES

EVERYWHERE = ("--listen", "0.0.0.0:0")
PATIENT = """
from fishd.window import access, web_server
access.PAIRING_TIMEOUT_S = web_server.REQUEST_TIMEOUT_S = 1e4
"""
"""Code of a window that ends no slow connection but for want of a place."""
SAME_HISTORY = "from fishd.window import fish_link; fish_link.HISTORY_AGE_S = 1e9"


@pytest.fixture
def open_window(daemon: Daemon, tmp_path: Path) -> Iterator[WindowProcess]:
    """Yield a window for the network."""
    with running_window(tmp_path, *EVERYWHERE, fish=daemon.endpoint) as window:
        yield window


async def pair_tablet(window: WindowProcess) -> Target:
    token = Devices(window.state).invite("watch")
    return await pair(own_address(), window.port, token)


@asynccontextmanager
async def attacking(attack: Attack, target: Target, requests: int) -> AsyncIterator[None]:
    """Attack a window, and begin once it has got this many requests."""
    enough, count = asyncio.Event(), 0

    def sent() -> None:
        nonlocal count
        count += 1
        if count == requests:
            enough.set()

    task = asyncio.ensure_future(attack(target, sent))
    try:
        await enough.wait()
        yield
        assert not task.done()
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


@pytest.mark.parametrize("name", NETWORK_ATTACKS)
async def test_an_emergency_stop_gets_through_an_attack_from_its_own_address(
    open_window: WindowProcess, daemon: Daemon, name: str
) -> None:
    here = Target("127.0.0.1", open_window.port)
    for target in (here, await pair_tablet(open_window)):
        requests = max(SLOW_BODIES, HISTORIES, FLOODS)
        async with attacking(NETWORK_ATTACKS[name], target, requests):
            for presser in (here, target):
                assert await press(presser) is not None
    assert daemon.status().mode == "estop"


@pytest.mark.parametrize("sent", [b"", b"POST /api/pair HTTP/1.1\r\nHost: localhost\r\n"])
async def test_connections_of_others_take_no_place_of_this_machine(
    daemon: Daemon, tmp_path: Path, sent: bytes
) -> None:
    if own_address() == "127.0.0.1":
        pytest.skip("this machine has no other address")
    with running_window(tmp_path, *EVERYWHERE, changes=PATIENT, fish=daemon.endpoint) as window:
        here, there = Target("127.0.0.1", window.port), Target(own_address(), window.port)
        reader, writer = await here.connect()
        others = [await there.connect() for _ in range(PLACES + 20)]
        for _, other in others:
            other.write(sent)
        ends = [asyncio.create_task(other.read()) for other, _ in others]
        while len(others_left := [end for end in ends if not end.done()]) > PLACES:
            await asyncio.wait(others_left, return_when=asyncio.FIRST_COMPLETED)
        writer.write(here.request("POST", "/api/fish/fish/estop", body=b"{}"))
        assert b'"outcome":"mode estop"' in await reader.read()
        writers = [writer, *(other for _, other in others)]
        for each in writers:
            each.close()
        await asyncio.gather(*(w.wait_closed() for w in writers), return_exceptions=True)
        await asyncio.gather(*ends, return_exceptions=True)


async def test_a_window_does_not_read_all_that_a_page_sends(open_window: WindowProcess) -> None:
    here = Target("127.0.0.1", open_window.port)
    sent = 0

    def count() -> None:
        nonlocal sent
        sent += 1

    attack = NETWORK_ATTACKS[f"{FLOODS} WebSockets full of messages"]
    with suppress(TimeoutError):
        async with asyncio.timeout(3.0):
            await attack(here, count)
    assert sent < 3000 * FLOODS  # of 200 messages each: 10 MB a page


async def test_all_pages_that_open_share_one_history(daemon: Daemon, tmp_path: Path) -> None:
    with running_window(tmp_path, changes=SAME_HISTORY, fish=daemon.endpoint) as window:
        async with Browser(window.url) as browser:
            while (await browser.get("/api/fish"))[0]["state"] != "live":
                pass
            histories = []
            for _ in range(3):
                async with open_page(browser) as page:
                    histories.append((await page.until("history"))["seq"])
                    await page.until("ticks", lambda ticks: ticks[-1]["seq"] > histories[0][-1])
            assert histories == 3 * histories[:1]


@pytest.mark.parametrize("name", DISK_TROUBLES)
async def test_an_emergency_stop_waits_for_no_disk_and_no_lock(
    daemon: Daemon, tmp_path: Path, name: str
) -> None:
    state = tmp_path / "window"
    state.mkdir(mode=0o700)
    with ExitStack() as stack:
        try:
            stack.enter_context(mounted(state))
        except OSError:
            pytest.skip("this user may not mount")
        window = stack.enter_context(running_window(tmp_path, *EVERYWHERE, fish=daemon.endpoint))

        tablet = await pair_tablet(window)
        unsee(state)
        with DISK_TROUBLES[name](state):
            for presser in (tablet, Target("127.0.0.1", window.port), tablet):
                assert await press(presser) is not None


async def test_an_emergency_stop_waits_for_no_folder_of_runs(
    daemon: Daemon, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    runs.mkdir()
    with running_window(tmp_path, fish=daemon.endpoint) as window, ExitStack() as stack:
        try:
            stack.enter_context(stalled(runs))
        except OSError:
            pytest.skip("this user may not mount")
        here = Target("127.0.0.1", window.port)
        paths = ["/api/runs", "/api/runs/any/plot.png", "/api/trash", "/api/results?run=any"]
        paths += ["/api/runs/any/download/all.zip", "/api/runs/any/download/rows.csv"]
        paths += ["/api/fish/fish/queue"]
        asking = [asyncio.ensure_future(here.exchange(here.request("GET", path))) for path in paths]
        for _ in range(3):
            await asyncio.sleep(0.1)
            assert await press(here) is not None
        assert not any(task.done() for task in asking)
        for task in asking:
            task.cancel()


async def test_a_paired_device_stops_the_fish_after_a_restart_with_a_damaged_file(
    daemon: Daemon, tmp_path: Path
) -> None:
    with running_window(tmp_path, fish=daemon.endpoint) as window:
        token = Devices(window.state).invite("watch")
        tablet = Target("127.0.0.1", window.port)

        tablet = await pair("127.0.0.1", window.port, token)
    (window.state / "devices.json").write_text("{")
    settings = "pair_all: true"  # this machine needs pairing, too
    with running_window(tmp_path, settings=settings, fish=daemon.endpoint) as window:
        assert await press(tablet._replace(port=window.port, cookie="")) is None
        assert await press(tablet._replace(port=window.port)) is not None


async def test_when_a_device_was_seen_is_stored_once_the_disk_allows_it(
    open_window: WindowProcess,
) -> None:
    tablet = await pair_tablet(open_window)
    unsee(open_window.state)
    assert await press(tablet) is not None
    file = open_window.state / "devices.json"
    wait_until(lambda: json.loads(file.read_bytes())["devices"][0]["seen"] > 0.0)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
async def test_all_presses_while_fishd_is_dead_or_hangs_share_one_last_resort(
    own_daemon: Daemon, tmp_path: Path, number: signal.Signals
) -> None:
    with running_window(tmp_path, fish=own_daemon.endpoint) as window:
        own_daemon.process.send_signal(number)
        here = Target("127.0.0.1", window.port)

        pressing = asyncio.gather(*(press(here) for _ in range(60)))
        most = 0
        while not pressing.done():
            most = max(most, len(list_children(window.pid)))
            await asyncio.sleep(0.005)
        assert None not in pressing.result()
        assert most == 1
        payload = here.request("POST", "/api/fish/fish/estop", body=b"{}")
        assert b'"way":"last resort"' in await here.exchange(payload)
        own_daemon.process.send_signal(signal.SIGCONT)


REFUSED = [
    (("Content-Encoding: deflate",), b"garbage", b"415"),
    (("Content-Encoding: gzip",), b"\x1f\x8b", b"415"),
    (("Transfer-Encoding: chunked",), b"", b"411"),
    ((), b'{"token":"%b"}' % (600 * b"x"), b"413"),
    (("Content-Length: 513",), b"", b"413"),
    (("Content-Length: 9",), b"{", b"408"),
]


@pytest.mark.parametrize("path", ["/api/pair", "/api/unpair"])
async def test_a_body_that_is_compressed_too_long_or_late_is_refused_without_a_mistake(
    daemon: Daemon, tmp_path: Path, path: str
) -> None:
    with running_window(tmp_path, fish=daemon.endpoint) as window:
        here = Target("127.0.0.1", window.port)
        for headers, body, status in REFUSED:
            answer = await here.exchange(here.request("POST", path, *headers, body=body))
            assert answer[9:12] == status, (headers, answer)
        assert window.end()[2].count("\n") <= 1  # no traceback
