"""A stranger who tries keys gets nothing, and costs fishd nothing that stays."""

import struct
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TypeAlias

import zmq
from rigs.gateway_processes import gateways
from rigs.keyed_daemon import KeyedDaemon
from rigs.processes import Daemon, wait_until

Socket: TypeAlias = "zmq.Socket[bytes]"
TRIES, BATCH = 1000, 50
WARM_UP = 5
"""Number of batches until the memory of a process stays the same, as 24 of them showed."""
REFUSALS = {
    zmq.DEALER: zmq.EVENT_HANDSHAKE_FAILED_AUTH,
    zmq.SUB: zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL,  # a subscriber hears nothing, and tries again
}
MAX_GROWTH_PAGES = 2**19 // 4096
"""Growth of a process that a thousand tries may cause: half a megabyte [pages]."""


def usage(daemon: Daemon) -> dict[str, tuple[int, int]]:
    """Return number of open files and resident memory [pages] of fishd and its gateways."""
    local, network = gateways(daemon)
    processes = {"fishd": daemon.process.pid, "local": local, "network": network}
    return {
        name: (
            len(list(Path(f"/proc/{pid}/fd").iterdir())),
            int(Path(f"/proc/{pid}/statm").read_text().split()[1]),
        )
        for name, pid in processes.items()
    }


def has_closed_files(daemon: Daemon, before: dict[str, tuple[int, int]]) -> bool:
    now = usage(daemon)
    return all(now[name][0] <= before[name][0] for name in before)


def try_keys(rig: KeyedDaemon, address: str, kind: int) -> None:
    """Connect with a batch of new keys; each must be refused, and get no message."""
    at_once = BATCH if kind == zmq.SUB else 1  # a subscriber notices its refusal after two seconds
    with zmq.Context() as context:
        for _ in range(BATCH // at_once):
            clients = [try_key(context, rig, address, kind) for _ in range(at_once)]
            for client, events in clients:
                (event,) = struct.unpack_from("=H", events.recv_multipart()[0])
                assert event == REFUSALS[kind]
                assert not client.poll(0)
                client.disable_monitor()
                for socket in (events, client):
                    socket.close()


def try_key(
    context: "zmq.Context[Socket]", rig: KeyedDaemon, address: str, kind: int
) -> tuple[Socket, Socket]:
    """Connect with a new key, and request a stop; return the socket, and that of its events."""
    client = context.socket(kind)
    client.set(zmq.LINGER, 0)
    client.set(zmq.CURVE_SERVERKEY, rig.key("fishd").encode())
    client.curve_publickey, client.curve_secretkey = zmq.curve_keypair()
    if kind == zmq.SUB:
        client.subscribe(b"")
    events = client.get_monitor_socket(
        zmq.EVENT_HANDSHAKE_FAILED_AUTH
        | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
        | zmq.EVENT_HANDSHAKE_SUCCEEDED
    )
    client.connect(address)
    if kind == zmq.DEALER:
        with suppress(zmq.Again):  # the refusal was faster, and nothing is connected
            client.send_json({"v": 2, "op": "estop"}, zmq.DONTWAIT)
    return client, events


def test_a_thousand_unknown_keys_get_nothing_and_leave_nothing(tmp_path: Path) -> None:
    rig = KeyedDaemon(tmp_path, driver="drive")
    with rig.running() as daemon:
        telemetry = daemon.status().keyed_telemetry
        sockets = ((rig.endpoint, zmq.DEALER), (telemetry, zmq.SUB))
        for address, kind in sockets * WARM_UP:
            try_keys(rig, address, kind)
        start = daemon.status()
        for _ in range(2):  # what was needed at most at a time is kept, and serves the next tries
            before = usage(daemon)
            for _ in range(TRIES // BATCH // 2):
                for address, kind in sockets:
                    try_keys(rig, address, kind)
            wait_until(partial(has_closed_files, daemon, before))
            after, end = usage(daemon), daemon.status()
            growth = {name: pages - before[name][1] for name, (_, pages) in after.items()}
            if max(growth.values()) <= MAX_GROWTH_PAGES:
                break
        assert max(growth.values()) <= MAX_GROWTH_PAGES, growth
        assert (end.mode, end.recovered_errors) == ("idle", start.recovered_errors)
        assert rig.fishctl("driver", "status").returncode == 0
