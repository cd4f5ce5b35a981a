"""Access over the network: a real fishd, whose clients have keys, over TCP."""

import contextlib
import json
import os
import re
import signal
import sys
import time
from collections import deque
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import zmq
from rigs.documents import FENCE, ROOT
from rigs.gateway_processes import gateways
from rigs.keyed_daemon import KeyedDaemon
from rigs.processes import (
    FISHCTL,
    PATIENCE,
    Daemon,
    Process,
    Subscriber,
    call,
    one_line,
    sets,
    wait_until,
)
from rigs.window_process import Browser, WindowProcess, open_page, running_window

from fishd.client import Fish, Refused
from fishd.client.zmq_sockets import connect_subscriber
from fishd.core import files
from fishd.core.errors import NoKey
from fishd.daemon.gateway.keys import EMPTY_SETTLE_TIME_S

SILENCE_S = 5.0
"""Time without a message after which a client looks for the reason [s]."""


@pytest.fixture(scope="module")
def keyed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KeyedDaemon]:
    """Yield a fishd that knows `driver` and `watcher`, and does not know `stranger`."""
    rig = KeyedDaemon(tmp_path_factory.mktemp("k"), driver="drive", watcher="watch", stranger="")
    with rig.running():
        yield rig


@pytest.fixture
def as_client(monkeypatch: pytest.MonkeyPatch, keyed: KeyedDaemon) -> Iterator[type["Client"]]:
    with contextlib.ExitStack() as stack:
        Client.monkeypatch, Client.keyed, Client.stack = monkeypatch, keyed, stack
        yield Client


class Client:
    """Connections of the clients of a test."""

    monkeypatch: pytest.MonkeyPatch
    keyed: KeyedDaemon
    stack: contextlib.ExitStack

    @classmethod
    def connect(cls, name: str, timeout: float = PATIENCE) -> Fish:
        cls.monkeypatch.setenv("FISHD_KEYS", str(cls.keyed.folder / name))
        return cls.stack.enter_context(Fish(cls.keyed.endpoint, timeout=timeout))

    @classmethod
    def subscribe_to_reports(cls) -> Subscriber:
        """Return a subscriber of this machine, which no restart of a gateway with keys cuts off.

        A subscriber with a key may miss the report of a restart: fishd sends it a second later, to
        those that have connected again by then.
        """
        local = Subscriber(cls.keyed.daemon.telemetry, b"event")
        return cls.stack.enter_context(local).connected()


def test_a_client_with_the_role_drive_drives(as_client: type[Client]) -> None:
    fish = as_client.connect("driver")
    state = fish.set_controller("swing", C=0.5)
    assert next(tick for tick in fish.ticks() if tick.seq >= state.seq).controller == "swing"
    with fish.lease("experiment"):
        assert fish.set_parameters(C=0.6).parameters["C"] == 0.6
    assert fish.estop("enough").mode == "estop"
    assert fish.estop_taken_by == "control"
    assert fish.clear_fault().mode == "idle"


def test_a_client_with_the_role_watch_reads_and_stops_but_does_not_drive(
    as_client: type[Client], keyed: KeyedDaemon
) -> None:
    fish = as_client.connect("watcher")
    assert next(fish.ticks()).seq
    assert fish.config()["network"]["control"] == keyed.endpoint
    assert fish.estop("danger").mode == "estop"
    for command in (fish.stop, fish.clear_fault, lambda: fish.set_controller("swing")):
        with pytest.raises(Refused, match=r"needs the role drive; .* watcher, has the role watch"):
            command()
    assert keyed.fishctl("watcher", "estop").returncode == 0
    assert fish.status().mode == "estop"
    as_client.connect("driver").clear_fault()
    refused = keyed.fishctl("watcher", "set-controller", "swing")
    assert "'set-controller' needs the role drive" in one_line(refused)


def test_a_key_that_fishd_does_not_know_is_named_at_once(
    as_client: type[Client], keyed: KeyedDaemon
) -> None:
    line = re.escape(f"'drive {keyed.key('stranger')} NAME'")
    stranger = as_client.connect("stranger")
    for _ in range(2):
        with pytest.raises(NoKey, match=f"this key is not known to the fishd at .*: add .*{line}"):
            stranger.status()
    keyed.add("watch", "stranger")
    assert stranger.status().robot == "simulated"
    keyed.remove("stranger")


def test_a_client_without_a_key_is_told_that_it_needs_one(keyed: KeyedDaemon) -> None:
    with Fish(keyed.endpoint, timeout=PATIENCE) as fish, pytest.raises(NoKey, match="needs a key"):
        fish.status()
    done = call(FISHCTL, "--endpoint", keyed.endpoint, "status")
    assert f"has no line '{keyed.endpoint} KEY'; add it" in one_line(done)


def test_another_key_of_fishd_than_the_expected_one_is_named(
    as_client: type[Client], keyed: KeyedDaemon
) -> None:
    keyed.know("driver", keyed.key("watcher"))
    fish = as_client.connect("driver")
    keyed.know("driver", keyed.key("fishd"))
    with pytest.raises(NoKey, match=r"has another key than in its line in .*known, or"):
        fish.status()


def test_a_key_for_a_fishd_that_uses_none_is_refused(as_client: type[Client]) -> None:
    with zmq.Context() as context, context.socket(zmq.ROUTER) as plain:
        port = plain.bind_to_random_port("tcp://127.0.0.1")
        known = as_client.keyed.folder / "stranger" / "known"
        known.write_text(f"tcp://127.0.0.1:{port} {as_client.keyed.key('fishd')}\n")
        as_client.monkeypatch.setenv("FISHD_KEYS", str(known.parent))
        fish = as_client.stack.enter_context(Fish(f"tcp://127.0.0.1:{port}", timeout=PATIENCE))
        with pytest.raises(NoKey, match="or uses no keys; compare the line"):
            fish.status()
    as_client.keyed.know("stranger", as_client.keyed.key("fishd"))


def test_a_removed_key_ends_at_once_for_connections_that_exist(
    as_client: type[Client], keyed: KeyedDaemon
) -> None:
    keyed.add("drive", "stranger")
    wait = (
        "import asyncio\n"
        "from fishd.client import AsyncFish\n"
        "async def wait():\n"
        f"    async with AsyncFish({keyed.endpoint!r}, timeout={SILENCE_S}) as fish:\n"
        "        print((await fish.status()).mode, flush=True)\n"
        "        async for event in fish.events(): pass\n"
        "asyncio.run(wait())\n"
    )
    environment = keyed.environment("stranger")
    with Process(sys.executable, "-c", wait, env=environment) as waiting:
        assert waiting.process.stdout
        assert waiting.process.stdout.readline() == "idle\n"
        guest, driver = as_client.connect("stranger", SILENCE_S), as_client.connect("driver")
        guest_ticks, driver_ticks = guest.ticks(), driver.ticks()
        reports = as_client.subscribe_to_reports()
        next(guest_ticks)
        next(driver_ticks)
        keyed.remove("stranger")
        with pytest.raises(Refused, match=r"is no longer known to fishd: see .*known"):
            guest.stop()
        removal = reports.until(kind="gateway")
        assert removal["message"].endswith("fishd/known: removed: stranger")
        seq = driver.status().seq
        assert any(tick.seq > seq for tick in driver_ticks)  # the others have connected again
        with pytest.raises(Refused, match="is no longer known"):
            list(guest_ticks)
        assert "no longer known" in waiting.finish()[2]


def test_a_refused_subscriber_gets_telemetry_once_its_key_is_known(
    as_client: type[Client], keyed: KeyedDaemon
) -> None:
    address = as_client.connect("driver").status().telemetry
    access = as_client.connect("stranger").access
    with zmq.Context() as context:
        messages = connect_subscriber(context, address, b"tick", access=access)
        monitor = messages.get_monitor_socket(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL)
        for _ in range(2):
            assert monitor.poll(PATIENCE * 1e3)
            monitor.recv_multipart()
        keyed.add("watch", "stranger")
        assert messages.poll(PATIENCE * 1e3)
        assert messages.recv_multipart()[0] == b"tick"
        context.destroy(linger=0)
    keyed.remove("stranger")


def test_a_change_of_role_holds_from_the_next_request_on(
    as_client: type[Client], keyed: KeyedDaemon
) -> None:
    keyed.add("drive", "stranger")
    fish = as_client.connect("stranger")
    assert fish.stop().mode == "idle"
    keyed.remove("stranger")
    keyed.add("watch", "stranger")
    with pytest.raises(Refused, match="has the role watch"):
        fish.stop()
    assert fish.status().mode == "idle"
    keyed.remove("stranger")


def test_a_malformed_line_lets_only_its_own_client_out(
    as_client: type[Client], tmp_path: Path
) -> None:
    keyed = as_client.keyed = KeyedDaemon(tmp_path, driver="drive", watcher="watch")
    as_client.stack.enter_context(keyed.running())
    driver = as_client.connect("driver")
    reports = as_client.subscribe_to_reports()
    assert driver.stop().mode == "idle"
    keyed.write(keyed.known.read_text().replace("watch", "wach"))
    assert driver.stop().mode == "idle"
    with pytest.raises(NoKey, match="not known"):
        as_client.connect("watcher").status()
    problem = reports.until(kind="gateway")
    assert "known, line 3: 'drive KEY NAME'" in problem["message"]


def test_a_malformed_line_from_a_restart_of_the_gateway_is_named_once(
    as_client: type[Client], tmp_path: Path
) -> None:
    keyed = as_client.keyed = KeyedDaemon(tmp_path, driver="drive")
    as_client.stack.enter_context(keyed.running())
    with Subscriber(keyed.daemon.telemetry, b"event") as subscriber:
        subscriber.connected()
        wait_until(lambda: len(gateways(keyed.daemon)) == 2)
        network = gateways(keyed.daemon)[-1]
        os.kill(network, signal.SIGSTOP)
        files.write_atomically(keyed.known, f"{keyed.known.read_text()}nonsense\n")
        os.kill(network, signal.SIGKILL)
        event = subscriber.until(kind="gateway", data={"gateway": "network"})
    assert event["level"] == "warning"
    assert "fishd/known, line 3: 'drive KEY NAME'" in event["message"]


def test_an_emptied_file_lets_no_client_in_but_not_while_it_is_written(
    as_client: type[Client], keyed: KeyedDaemon
) -> None:
    driver = as_client.connect("driver")
    before = keyed.known.read_text()

    def stop_while_it_is_written() -> bool:
        assert driver.stop().mode == "idle"  # fishd has read the file
        begun = time.monotonic()
        try:
            with keyed.known.open("w") as file:  # as an editor that empties and then writes it
                try:
                    mode = driver.stop().mode
                finally:
                    file.write(before)
            return (mode, driver.stop().mode) == ("idle", "idle")
        except (Refused, NoKey):
            # It was empty for longer than an editor leaves it so.
            assert time.monotonic() - begun > EMPTY_SETTLE_TIME_S / 2
            keyed.write(before)
            return False

    wait_until(stop_while_it_is_written)
    for change in (keyed.known.unlink, partial(keyed.write, "")):
        change()
        with pytest.raises(Refused, match="no longer known"):
            deque(iter(driver.stop, None), maxlen=0)
        keyed.write(before)
        assert driver.stop().mode == "idle"


def test_sockets_of_this_machine_need_no_key(keyed: KeyedDaemon) -> None:
    assert keyed.daemon.fishctl("stop").returncode == 0
    with Subscriber(keyed.daemon.telemetry) as subscriber:
        assert subscriber.until(mode="idle")


async def test_a_window_recovers_once_its_removed_key_is_known_again(
    keyed: KeyedDaemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keyed.add("watch", "stranger")
    monkeypatch.setenv("FISHD_KEYS", str(keyed.folder / "stranger"))
    with running_window(tmp_path, fish=keyed.endpoint) as window:
        async with Browser(window.url) as browser, open_page(browser) as page:
            await page.until("ticks")
            keyed.remove("stranger")
            lost = await page.until("connection", lambda link: link["state"] == "lost")
            assert "known to" in lost["message"]
            keyed.add("watch", "stranger")
            await page.until("connection", lambda link: link["state"] == "live")
    keyed.remove("stranger")


def test_verbs_that_follow_telemetry_work_with_a_key(keyed: KeyedDaemon, tmp_path: Path) -> None:
    watch = (FISHCTL, "--endpoint", keyed.endpoint, "watch", "--json")
    with Process(*watch, env=keyed.environment("watcher")) as watching:
        assert watching.process.stdout
        assert json.loads(watching.process.stdout.readline())["mode"] == "idle"
        status, _, errors = watching.end(signal.SIGINT)
    assert (status, errors) == (0, "")
    recorded = keyed.fishctl("watcher", "record", "--for", "1", "--json", str(tmp_path / "a.mcap"))
    assert recorded.returncode == 0, recorded.stderr
    assert (tmp_path / "a.mcap").exists()


async def test_the_window_works_with_a_key(
    keyed: KeyedDaemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FISHD_KEYS", str(keyed.folder / "driver"))
    with running_window(tmp_path, fish=keyed.endpoint) as window:
        async with Browser(window.url) as browser, open_page(browser) as page:
            await page.swim()


def test_keys_made_with_fishctl_connect_two_that_add_the_printed_lines(tmp_path: Path) -> None:
    rig = KeyedDaemon(tmp_path / "k")
    made = call(FISHCTL, "keygen", "--to", str(rig.folder / "anna"))
    assert made.returncode == 0, made.stderr
    (line,) = re.findall(r"^(drive .{40} \S+)$", made.stdout, re.MULTILINE)
    rig.write(f"{line}\n")
    rig.know("anna", rig.key("fishd"))
    with rig.running():
        command = (FISHCTL, "--keys", f"{rig.folder}/anna", "--endpoint", rig.endpoint)
        assert "running: swing" in call(*command, "set-controller", "swing").stdout
    other = json.loads(call(FISHCTL, "keygen", "--to", f"{rig.folder}/bob", "--json").stdout)
    assert other == {"folder": f"{rig.folder}/bob", "public_key": rig.key("bob")}
    again = call(FISHCTL, "keygen", "--to", str(rig.folder / "anna"))
    assert "anna/key: it exists, and is not overwritten" in one_line(again)


def test_a_folder_of_keys_that_others_may_write_is_refused_by_fishd_fishctl_and_the_window(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = KeyedDaemon(tmp_path / "k", anna="drive")
    anna, theirs = rig.folder / "anna", rig.folder / "fishd"
    theirs.chmod(0o770)
    with Daemon(tmp_path, *rig.settings) as daemon:
        status, _, errors = daemon.finish()
    assert (status, errors.count("\n")) == (78, 1)
    assert f"{theirs}: other users may change it (mode 770); run 'chmod go-w {theirs}'" in errors
    theirs.chmod(0o700)
    anna.chmod(0o777)
    problem = f"{anna}: other users may change it (mode 777); run 'chmod go-w {anna}'"
    monkeypatch.setenv("FISHD_KEYS", str(anna))
    with rig.running():
        assert problem in one_line(rig.fishctl("anna", "status"))
        with WindowProcess(tmp_path, fish=rig.endpoint) as window:
            status, _, errors = window.finish()
        assert (status, errors.count("\n")) == (1, 1)
        assert problem in errors
        assert problem in one_line(call(FISHCTL, "keygen", "--to", str(anna)))
        anna.chmod(0o700)
        assert rig.fishctl("anna", "status").returncode == 0


def test_no_client_comes_in_while_others_may_write_the_folder_of_keys(
    as_client: type[Client], tmp_path: Path
) -> None:
    keyed = as_client.keyed = KeyedDaemon(tmp_path, driver="drive")
    as_client.stack.enter_context(keyed.running())
    reports = as_client.subscribe_to_reports()
    next(as_client.connect("driver").ticks())  # the gateway has read the file
    folder = keyed.known.parent
    folder.chmod(0o777)
    with pytest.raises(NoKey, match="not known"):
        as_client.connect("driver").status()
    problem = reports.until(kind="gateway")
    assert problem["message"].endswith(f"run 'chmod go-w {folder}'")
    folder.chmod(0o700)
    assert as_client.connect("driver").stop().mode == "idle"


def test_a_plain_client_connects_as_the_page_says(keyed: KeyedDaemon) -> None:
    page = (ROOT / "docs" / "reference" / "protocol.md").read_text(encoding="utf-8")
    (example,) = [code for _, code in FENCE.findall(page) if "CURVE_SERVERKEY" in code]
    arguments = (keyed.endpoint, str(keyed.folder / "watcher"), keyed.key("fishd"))
    done = call(sys.executable, "-c", example, *arguments)
    assert (done.stdout, done.stderr) in (("idle\n", ""), ("running\n", ""))


@pytest.mark.parametrize(
    ("settings", "problem"),
    [
        (["network.keys=nowhere"], "nowhere/key: there is no such file; 'fishctl keygen --to"),
        (["network.control=ipc:///tmp/x"], "network.control: 'ipc:///tmp/x' is not valid: tcp://"),
        (["telemetry.address=tcp://0.0.0.0:0"], "could be read without a key, but network.keys"),
    ],
    ids=["no key", "not TCP", "open telemetry"],
)
def test_fishd_does_not_start_with_wrong_access(
    settings: list[str], problem: str, tmp_path: Path
) -> None:
    rig = KeyedDaemon(tmp_path / "k")
    with Daemon(tmp_path, *rig.settings, *sets(*settings)) as daemon:
        status, _, errors = daemon.finish()
    assert status == 78
    assert problem in errors
    assert errors.count("\n") == 1
