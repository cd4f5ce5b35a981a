"""A replay, which subscribers and clients read like a fishd, and which refuses commands."""

import re
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq
from rigs.processes import FISHCTL, PATIENCE, Process, Subscriber, fishctl, one_line, wait_until
from rigs.recordings import record_run, swum

from fishd.client import Fish, Refused
from fishd.core import addresses
from fishd.core.errors import StartupError
from fishd.core.process import unix_sockets
from fishd.recording import open_run
from fishd.recording.replay import Replay

pytestmark = pytest.mark.slow


@pytest.fixture
def replay(tmp_path: Path) -> Iterator[Replay]:
    run = open_run(record_run(swum(), tmp_path / "run", source="simulation"))
    with Replay(run, "tcp://127.0.0.1:0", f"ipc://{tmp_path}/control") as made:
        yield made


def test_a_replay_is_the_recorded_bytes_at_the_recorded_speed(replay: Replay) -> None:
    recorded = [entry.payload for entry in replay._run.entries]
    with Subscriber(replay.telemetry) as subscriber:

        def hears() -> bool:
            replay._publisher.send_multipart([b"probe", b""])
            return bool(subscriber.socket.poll(20))

        wait_until(hears)
        player = threading.Thread(target=replay.play, args=(5.0,))
        player.start()
        heard = []
        while len(heard) < len(recorded):
            topic, payload = subscriber.socket.recv_multipart()
            if topic not in (b"probe", b"status"):  # of a virtual run, none was recorded
                heard.append(payload)
        player.join()
    assert heard == recorded


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_replay_ends_by_a_signal_and_leaves_no_socket(tmp_path: Path, number: int) -> None:
    run = record_run(swum(), tmp_path / "run", source="simulation")
    socket = tmp_path / "control"
    words = ("--speed", "0.01", "--address", "tcp://127.0.0.1:0", "--control", f"ipc://{socket}")
    process = Process(FISHCTL, "replay", str(run), *words)
    wait_until(lambda: bool(unix_sockets.find_listener(socket)))
    assert process.end(number)[::2] == (0, "")
    assert not socket.exists()


def test_a_client_sees_the_replay_and_cannot_steer_it(tmp_path: Path) -> None:
    run = record_run(swum(30.0), tmp_path / "run", source="simulation")
    control, telemetry = f"ipc://{tmp_path}/control", f"ipc://{tmp_path}/telemetry"
    words = ("--speed", "0.5", "--address", telemetry, "--control", control)
    player = Process(FISHCTL, "replay", str(run), *words)
    try:
        wait_until(lambda: bool(unix_sockets.find_listener(tmp_path / "control")))
        with Fish(control, timeout=PATIENCE) as fish:
            status = fish.status()
            assert (status.name, status.telemetry) == ("replay of run", telemetry)
            (first, second) = (tick for _, tick in zip(range(2), fish.ticks(), strict=False))
            assert second.seq == first.seq + 1
            after = fish.status()
            assert (after.mode, after.controller) == ("running", "swing")
            assert after.seq >= second.seq
            assert fish.config()["tick"] == 0.05
            with pytest.raises(Refused, match="it can be watched, but not controlled"):
                fish.stop()
    finally:
        ended = player.end(signal.SIGINT)[0]
    assert ended == 0


def test_an_address_in_use_is_said_in_one_line(replay: Replay, tmp_path: Path) -> None:
    with pytest.raises(StartupError, match=r"Address already in use.*with --address"):
        Replay(replay._run, replay.telemetry, f"ipc://{tmp_path}/other")
    with pytest.raises(StartupError, match="a fishd or another replay"):
        Replay(replay._run, "tcp://127.0.0.1:0", replay.control)
    with pytest.raises(StartupError, match="a fishd or another replay"):
        Replay(replay._run, replay.control, f"ipc://{tmp_path}/other")
    with pytest.raises(StartupError, match="is not an address to listen on"):
        Replay(replay._run, "nonsense", f"ipc://{tmp_path}/other")


def test_a_replay_leaves_the_telemetry_of_a_fishd_alone(tmp_path: Path) -> None:
    run = record_run(swum(0.2), tmp_path / "run")
    address = f"ipc://{tmp_path}/telemetry"
    with (
        addresses.claim_address(address),
        zmq.Context() as context,
        context.socket(zmq.PUB) as publisher,
    ):
        publisher.bind(address)
        words = ("--address", address, "--control", f"ipc://{tmp_path}/control")
        refused = fishctl("replay", str(run), *words)
        assert f"already serves {address}" in one_line(refused)
        assert unix_sockets.find_listener(tmp_path / "telemetry")


def test_a_replay_names_the_command_that_shows_it_and_not_the_live_fish(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = record_run(swum(0.2), tmp_path / "run")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    words = ("replay", str(run), "--address", f"ipc://{tmp_path}/telemetry", "--speed", "9")
    assert fishctl(*words).stdout.endswith("watch it with: fishctl watch\n")
    monkeypatch.setenv("FISHD_ENDPOINT", f"ipc://{tmp_path}/live")
    match = re.search(r"fishctl --endpoint (\S+) watch", fishctl(*words).stdout)
    assert match
    assert match[1] == f"ipc://{tmp_path}/fishd/control"
