"""A stranger who tries keys gets nothing, and costs fishd nothing that stays."""

import struct
from contextlib import suppress
from pathlib import Path

import zmq
from rigs.gateway_processes import gateways
from rigs.keyed_daemon import KeyedDaemon
from rigs.processes import Daemon, wait_until

TRIES, BATCH = 1000, 50
MAX_GROWTH_PAGES = 2**19 // 4096
"""Growth of a process that a thousand tries may cause: half a megabyte [pages]."""


def usage(daemon: Daemon) -> dict[str, tuple[int, int]]:
    """Return number of open files and resident memory [pages] of fishd and of its gateways."""
    processes = {"fishd": daemon.process.pid, **gateways(daemon)}
    return {
        name: (
            len(list(Path(f"/proc/{pid}/fd").iterdir())),
            int(Path(f"/proc/{pid}/statm").read_text().split()[1]),
        )
        for name, pid in processes.items()
    }


def try_keys(rig: KeyedDaemon, address: str, kind: int) -> None:
    """Connect with a batch of new keys; each must be refused, and get no message."""
    with zmq.Context() as context:
        for _ in range(BATCH):
            client = context.socket(kind)
            client.set(zmq.LINGER, 0)
            client.set(zmq.CURVE_SERVERKEY, rig.key("fishd").encode())
            client.curve_publickey, client.curve_secretkey = zmq.curve_keypair()
            if kind == zmq.SUB:
                client.subscribe(b"")
            events = client.get_monitor_socket(
                zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_SUCCEEDED
            )
            client.connect(address)
            if kind == zmq.DEALER:
                with suppress(zmq.Again):  # the refusal was faster, and nothing is connected
                    client.send_json({"v": 2, "op": "estop"}, zmq.DONTWAIT)
            event, status = struct.unpack("=HI", events.recv_multipart()[0])
            assert (event, status) == (zmq.EVENT_HANDSHAKE_FAILED_AUTH, 400)
            assert not client.poll(0)
            client.disable_monitor()
            for socket in (events, client):
                socket.close()


def test_a_thousand_unknown_keys_get_nothing_and_leave_nothing(tmp_path: Path) -> None:
    rig = KeyedDaemon(tmp_path, driver="drive")
    with rig.running() as daemon:
        telemetry = daemon.status().keyed_telemetry
        sockets = ((rig.endpoint, zmq.DEALER), (telemetry, zmq.SUB))
        for address, kind in sockets:  # warms up
            try_keys(rig, address, kind)
        before, start = usage(daemon), daemon.status()
        assert sorted(before) == ["control", "fishd", "keyed-con", "keyed-tel", "telemetry"]
        for _ in range(TRIES // BATCH // 2):
            for address, kind in sockets:
                try_keys(rig, address, kind)
        wait_until(lambda: all(usage(daemon)[name][0] <= before[name][0] for name in before))
        after, end = usage(daemon), daemon.status()
        for name, (_, pages) in after.items():
            assert pages - before[name][1] <= MAX_GROWTH_PAGES, name
        assert (end.mode, end.recovered_errors) == ("idle", start.recovered_errors)
        assert rig.fishctl("driver", "status").returncode == 0
