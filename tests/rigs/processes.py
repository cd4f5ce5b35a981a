"""Starts and ends the real `fishd` and calls the real `fishctl`, as a user would."""

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import zmq

from fishd.client import Fish, NoDaemon

FISHD = str(Path(sys.executable).with_name("fishd"))
FISHCTL = str(Path(sys.executable).with_name("fishctl"))
PATIENCE = 20.0
"""How long anything may take before a test gives up on it [s]."""


class Daemon:
    """A running fishd with addresses of its own."""

    def __init__(self, folder: Path, *arguments: str, under: Sequence[str] = ()) -> None:
        """under: a command that starts the daemon, `setpriv` say."""
        self.endpoint = f"ipc://{folder}/control"
        own = [f"control.address={self.endpoint}", "telemetry.address=tcp://127.0.0.1:0"]
        settings = [word for setting in own for word in ("--set", setting)]
        self.process = subprocess.Popen(
            [*under, FISHD, *settings, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def wait_until_up(self) -> "Daemon":
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline and self.process.poll() is None:
            try:
                with Fish(self.endpoint, timeout=0.5) as fish:
                    self.telemetry = fish.status().telemetry
                return self
            except NoDaemon:
                time.sleep(0.02)
        raise AssertionError(f"fishd did not come up: {self.end()}")

    def fishctl(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [FISHCTL, "--endpoint", self.endpoint, *arguments],
            capture_output=True,
            text=True,
            check=False,
            timeout=PATIENCE,
        )

    def finish(self) -> tuple[int, str, str]:
        """Wait until it ends by itself; exit status, output and errors."""
        out, err = self.process.communicate(timeout=PATIENCE)
        return self.process.returncode, out, err

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str, str]:
        """Send a signal, if it still runs, and return exit status, output and errors."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.finish()


@contextlib.contextmanager
def running(folder: Path, *arguments: str, under: Sequence[str] = ()) -> Iterator[Daemon]:
    """A daemon that is up, and gone afterwards whatever happens."""
    daemon = Daemon(folder, *arguments, under=under)
    try:
        yield daemon.wait_until_up()
    finally:
        print(f"fishd said:\n{daemon.end()[2]}")  # which pytest shows for a test that failed


class Subscriber:
    """A bare ZeroMQ subscriber, as any program in any language would have it."""

    def __init__(self, address: str, topic: bytes = b"") -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self._context.socket(zmq.SUB)
        self.socket.set(zmq.SUBSCRIBE, topic)
        self.socket.set(zmq.RCVTIMEO, int(PATIENCE * 1000))
        self.socket.connect(address)

    def frames(self) -> list[bytes]:
        return self.socket.recv_multipart()

    def message(self) -> dict[str, Any]:
        _, payload = self.frames()
        message: dict[str, Any] = msgspec.json.decode(payload)
        return message

    def until(self, **wanted: Any) -> dict[str, Any]:
        """The first message in which these fields have these values."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            message = self.message()
            if all(message.get(name) == value for name, value in wanted.items()):
                return message
        raise AssertionError(f"no message with {wanted}")

    def close(self) -> None:
        self._context.destroy(linger=0)

    def __enter__(self) -> "Subscriber":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
