"""A fishd with access over the network, and folders with the keys of its clients."""

import contextlib
import os
import subprocess
import time
import weakref
from collections.abc import Iterator
from pathlib import Path

import zmq

from fishd.core import files, keys
from fishd.daemon.gateway.keys import FILE_QUIET_TIME_S
from rigs.processes import FISHCTL, Daemon, call, reserve_port, running, sets, wait_until


class KeyedDaemon:
    """Running fishd that knows clients by their keys."""

    def __init__(self, folder: Path, **roles: str) -> None:
        """Make all keys; roles: role of each client; empty for one that fishd does not know"""
        self.folder = folder
        reserved = reserve_port()
        weakref.finalize(self, reserved.close)
        self.endpoint = f"tcp://127.0.0.1:{reserved.getsockname()[1]}"
        self.known = folder / "fishd" / keys.KNOWN_FILE
        for name in ("fishd", *roles):
            public, secret = (key.decode() for key in zmq.curve_keypair())
            keys.make_keys(folder / name, public, secret)
        for name, role in roles.items():
            if role:
                self.add(role, name)
            self.know(name, self.key("fishd"))

    def key(self, name: str) -> str:
        """Return a public key."""
        return (self.folder / name / keys.PUBLIC_FILE).read_text().strip()

    def secret(self, name: str) -> str:
        """Return a secret key."""
        return keys.read_secret(self.folder / name)

    def add(self, role: str, name: str) -> None:
        """Add a line for a client to the file of fishd."""
        self.write(f"{self.known.read_text()}{role} {self.key(name)} {name}\n")

    def remove(self, name: str) -> None:
        """Remove the line of a client from the file of fishd."""
        lines = self.known.read_text().splitlines(keepends=True)
        self.write("".join(line for line in lines if self.key(name) not in line))

    def write(self, text: str) -> None:
        """Write the file of fishd, and wait until fishd takes the change for complete."""
        files.write_atomically(self.known, text)
        changed = self.known.stat().st_ctime
        wait_until(lambda: time.time() - changed > FILE_QUIET_TIME_S)

    def know(self, name: str, key: str) -> None:
        """Let a client expect this public key of fishd."""
        (self.folder / name / keys.KNOWN_FILE).write_text(f"{self.endpoint} {key}\n")

    def environment(self, name: str) -> dict[str, str]:
        """Return the environment of a program of this client."""
        return {**os.environ, "FISHD_KEYS": str(self.folder / name)}

    def fishctl(self, name: str, *arguments: str) -> "subprocess.CompletedProcess[str]":
        """Run fishctl as this client, and return the result."""
        command = (FISHCTL, "--endpoint", self.endpoint, *arguments)
        return call(*command, env=self.environment(name))

    @property
    def settings(self) -> list[str]:
        """Options of fishd."""
        return sets(
            f"network.keys={self.folder}/fishd",
            f"network.control={self.endpoint}",
            "network.telemetry=tcp://127.0.0.1:0",
        )

    @contextlib.contextmanager
    def running(self) -> Iterator[Daemon]:
        """Run fishd."""
        with running(self.folder, *self.settings) as self.daemon:
            yield self.daemon
