"""Addresses: valid ones, and those on which fishd listens, exactly as written."""

import socket
from pathlib import Path

import pytest

from fishd.config import load
from fishd.core.addresses import (
    find_connect_problem,
    find_listen_problem,
    is_local,
    listen,
    parse,
    reachable_address,
)
from fishd.core.errors import ConfigError


@pytest.mark.parametrize(
    "address",
    [
        "tcp://127.0.0.1:19900;0.0.0.0:19901",  # which ZeroMQ takes for a source and a target
        "tcp://127.999.1.1:9872",
        "tcp://[::1]]:9872",
        "tcp://::1:9872",
        "tcp://a b:9872",
        "tcp://host:١٢",
        "tcp://:9872",
        "tcp://host:999999999999",
        "ipc://",
        "ipc://@hidden",
        "udp://127.0.0.1:9872",
        "tcp://127.0.0.1:9872\n",
    ],
)
def test_what_zeromq_would_understand_in_another_way_is_no_address(address: str) -> None:
    assert find_listen_problem(address)
    with pytest.raises(ValueError, match=r"^tcp://HOST:PORT or ipc://PATH is needed"):
        parse(address)
    assert find_connect_problem(address)


@pytest.mark.parametrize(
    "address",
    ["tcp://127.0.0.1:9872", "tcp://fish.local:1", "tcp://[::1]:9872", "ipc:///tmp/x", "ipc://x"],
)
def test_hosts_and_paths_are_addresses(address: str) -> None:
    assert not find_listen_problem(address)
    assert not find_connect_problem(address)


@pytest.mark.parametrize(
    ("address", "local"),
    [
        ("tcp://127.0.0.1:1", True),
        ("tcp://localhost:1", True),
        ("ipc:///run/x", True),
        ("tcp://0.0.0.0:1", False),
        ("tcp://*:1", False),
        ("tcp://127.0.0.1.example:1", False),
    ],
)
def test_only_the_loopback_is_certain_to_be_this_machine(address: str, local: bool) -> None:
    assert is_local(address) is local


@pytest.mark.parametrize(
    "address", ["tcp://127.0.0.1:19900;0.0.0.0:19901", "tcp://127.999.1.1:9", "tcp://*:9"]
)
def test_requests_from_elsewhere_are_never_advised(address: str) -> None:
    with pytest.raises(ConfigError) as refusal:
        load(None, [f"control.address={address}"])
    assert "ipc://PATH or tcp://127.0.0.1:PORT is needed" in str(refusal.value)
    assert "0.0.0.0:" not in str(refusal.value).replace(address, "")


def test_port_0_is_any_that_is_free_and_clients_are_told_which() -> None:
    with listen("tcp://127.0.0.1:0", "telemetry.address") as server:
        port = server.getsockname()[1]
        assert reachable_address("tcp://127.0.0.1:0", server) == f"tcp://127.0.0.1:{port}"
        socket.create_connection(("127.0.0.1", port), 5.0).close()


def test_a_control_socket_is_for_user_and_group_only(tmp_path: Path) -> None:
    path = tmp_path / "control"
    with listen(f"ipc://{path}", "control.address", group=True):
        assert path.stat().st_mode & 0o777 == 0o660


def test_a_port_that_a_rival_listens_at_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    class Second(socket.socket):
        """Socket whose rival, bound to the same port, starts to listen first."""

        def bind(self, address: tuple[str, int]) -> None:
            super().bind(address)
            rival.listen()

    with socket.socket() as rival:
        rival.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        rival.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{rival.getsockname()[1]}"
        monkeypatch.setattr(socket, "socket", Second)
        monkeypatch.setattr("time.sleep", lambda seconds: rival.close())
        with listen(address, "telemetry.address") as server:
            assert reachable_address(address, server) == address
