"""An emergency stop of the window arrives though a thread, a disk or ZeroMQ fails."""

import asyncio
import signal
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from rigs.keyed_daemon import KeyedDaemon
from rigs.processes import PATIENCE, Daemon, reserve_port, wait_until
from rigs.window_process import NETWORK_HOST, Browser, open_page, running_window

from fishd.window.devices import Devices
from fishd.window.estop_path import ESTOP_THREADS
from fishd.window.job_requests import MAX_WAITING_REQUESTS

STALLED_KEYS = """
import signal, threading
from fishd.core import keys
real, is_stalled = keys.read_known, threading.Event()
def read_known(folder):
    if is_stalled.is_set():
        threading.Event().wait()
    return real(folder)
keys.read_known = read_known
signal.signal(signal.SIGUSR1, lambda *_: is_stalled.set())
"""
"""Code of a window: from SIGUSR1 on, the disk of its keys does not answer."""
STALLED_DISKS = """
import signal, threading
from fishd.window import register, runs
def stall(*_):
    threading.Event().wait()
def stall_all(*_):
    runs._is_empty = register.shutil.rmtree = stall
signal.signal(signal.SIGUSR1, stall_all)
"""
"""Code of a window: from SIGUSR1 on, the disks of its runs and of its state do not answer."""
SILENT = """
import signal, threading
from fishd.client import Fish
from fishd.window import estop_path
estop_path.ANSWER_TIMEOUT_S = 1e6
signal.signal(
    signal.SIGUSR1, lambda *_: setattr(Fish, "estop", lambda *_: threading.Event().wait())
)
"""
"""Code of a window: from SIGUSR1 on, a thread with an emergency stop waits forever."""
BROKEN = """
import signal, zmq
from fishd.client import Fish
def fail(*_):
    raise zmq.ZMQError(24)
def break_all(*_):
    Fish.probe_estop = Fish.status = Fish.estop = fail
signal.signal(signal.SIGUSR1, break_all)
"""
"""Code of a window: from SIGUSR1 on, no thread can open a socket of ZeroMQ."""


async def test_an_emergency_stop_over_the_network_reads_no_keys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keyed = KeyedDaemon(tmp_path, client="watch")
    monkeypatch.setenv("FISHD_KEYS", str(tmp_path / "client"))
    with (
        keyed.running() as daemon,
        running_window(tmp_path, changes=STALLED_KEYS, fish=keyed.endpoint) as window,
    ):
        async with Browser(window.url) as browser, open_page(browser) as page:
            window.process.send_signal(signal.SIGUSR1)
            await page.until("connection", lambda connection: connection["warning"])
            for _ in range(ESTOP_THREADS + 1):
                assert (await page.post("estop"))["way"] == "control"
        assert daemon.status().mode == "estop"


async def test_the_last_resort_runs_though_all_threads_of_emergency_stops_wait_forever(
    daemon: Daemon, tmp_path: Path
) -> None:
    with running_window(tmp_path, changes=SILENT, fish=daemon.endpoint) as window:
        async with Browser(window.url) as browser:
            window.process.send_signal(signal.SIGUSR1)
            for _ in range(ESTOP_THREADS + 1):
                answer = await browser.post("/api/fish/fish/estop")
                assert answer["way"] == "fishctl"
        assert daemon.status().mode == "estop"


async def test_an_error_of_zeromq_ends_neither_the_emergency_stop_nor_the_warning_nor_revocation(
    daemon: Daemon, tmp_path: Path
) -> None:
    with running_window(tmp_path, changes=BROKEN, fish=daemon.endpoint) as window:
        token = Devices(window.state).invite("watch")
        async with Browser(window.url, NETWORK_HOST) as browser:
            await browser.post("/api/pair", {"token": token, "name": "tablet"})
            async with open_page(browser) as page:
                window.process.send_signal(signal.SIGUSR1)
                await page.until("connection", lambda connection: connection["warning"])
                assert (await page.post("estop"))["way"] == "fishctl"
                window.ask("revoke", "tablet")
                while not page.sock.closed:
                    await page.sock.receive()
        wait_until(lambda: daemon.status().mode == "estop")
        assert window.end()[2].count("cannot be probed") == 1


async def test_a_window_whose_disks_do_not_answer_ends_at_sigterm(
    daemon: Daemon, tmp_path: Path
) -> None:
    with running_window(tmp_path, changes=STALLED_DISKS, fish=daemon.endpoint) as window:
        async with Browser(window.url) as browser, open_page(browser) as page:
            window.process.send_signal(signal.SIGUSR1)
            listing = asyncio.create_task(browser.get("/api/runs"))
            assert (await page.post("estop"))["way"] == "control"
            assert not listing.done()
            listing.cancel()
        window.process.terminate()
        assert window.process.wait(PATIENCE) == 0


async def test_requests_that_wait_for_the_disk_of_the_runs_are_refused_above_a_number(
    daemon: Daemon, tmp_path: Path
) -> None:
    with running_window(tmp_path, changes=STALLED_DISKS, fish=daemon.endpoint) as window:
        async with Browser(window.url) as browser:
            window.process.send_signal(signal.SIGUSR1)
            await browser.post("/api/fish/fish/estop")  # by then, the disk stalls
            waiting = [
                asyncio.create_task(browser.refusal("/api/runs"))
                for _ in range(MAX_WAITING_REQUESTS + 1)
            ]
            done, _ = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
            assert {task.result() for task in done} == {(503, "busy")}
            for task in waiting:
                task.cancel()
        window.process.terminate()
        assert window.process.wait(PATIENCE) == 0


async def test_an_emergency_stop_whose_last_resort_fails_is_no_mistake_of_the_window(
    tmp_path: Path,
) -> None:
    with closing(reserve_port()) as port, ExitStack() as stack:
        endpoint = f"tcp://127.0.0.1:{port.getsockname()[1]}"  # where no fishd listens
        window = stack.enter_context(running_window(tmp_path, fish=endpoint))

        async with Browser(window.url) as browser:
            refusal = await browser.refusal("/api/fish/fish/estop", {})
            assert refusal == (503, "no-daemon")
            assert await browser.refusal("/api/fish/shark/estop", {}) == (404, "no-fish")
