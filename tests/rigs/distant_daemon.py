"""A fishd that is reached over TCP, through a path that can be cut off."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Self

from fishd.core import addresses
from rigs import half_open
from rigs.processes import Daemon, reserve_port, sets


class DistantDaemon(Daemon):
    """Running fishd on TCP ports of this machine; `path` leads to it from `distant_endpoint`."""

    path: half_open.Path

    def __init__(self, folder: Path, port: int, *arguments: str) -> None:
        endpoint = f"tcp://{half_open.HOST}:{port}"
        super().__init__(folder, *sets(f"control.address={endpoint}"), *arguments)
        self.endpoint = endpoint
        self.distant_endpoint = endpoint.replace(half_open.HOST, half_open.PATH_HOST)
        self.control_port = port

    def wait_until_up(self) -> Self:
        super().wait_until_up()
        where = addresses.parse(self.telemetry)
        assert isinstance(where, addresses.Tcp)
        self.telemetry_port = int(where.port)
        return self

    @property
    def seq(self) -> int:
        """Number of the latest tick, requested without the path."""
        return self.status().seq


@contextlib.contextmanager
def running_at_a_distance(folder: Path, *arguments: str) -> Iterator[DistantDaemon]:
    """Run a fishd, and a path to it."""
    with reserve_port() as reserved:
        port = reserved.getsockname()[1]
        with DistantDaemon(folder, port, *arguments) as daemon:
            daemon.wait_until_up()
            with half_open.Path(port, daemon.telemetry_port) as daemon.path:
                yield daemon
            print(f"fishd said:\n{daemon.end()[2]}")  # pytest shows this for a failed test
