"""Real `fishd` and `fishctl` processes."""

import contextlib
import os
import signal
import socket as sockets
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import msgspec
import zmq

from common import processes
from common.in_process import fishctl
from common.processes import FISHCTL, FISHD, PATIENCE, call, sets, wait_until
from fishd.client import Fish, NoDaemon
from fishd.core.signals import Status
from rigs import preloaded

__all__ = [
    "EXPERIMENT", "FISHCTL", "FISHD", "LEASE", "PATIENCE", "Daemon", "Process", "Subscriber",
    "addresses", "call", "fishctl", "install", "is_stopped", "one_line", "reserve_port",
    "running", "sets", "wait_until",
]  # fmt: skip


def one_line(done: subprocess.CompletedProcess[str]) -> str:
    """Return the message of a failed command, the only line on standard error."""
    assert done.returncode != 0
    assert done.stdout == ""
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


LEASE = 6.0
"""Time after which an experiment without renewals loses an unhurried fish [s]."""
START: tuple[str, ...] = (FISHD,)
"""Command that starts a fishd."""
EXPERIMENT: tuple[str, ...] = (FISHCTL,)
"""Command that starts a separate fishctl, for an experiment on a fishd."""
if not os.environ.get("JUDGES_REAL_TIME"):
    _settings = sets(f"control.lease={LEASE:g}")
    START = (*preloaded.UNHURRIED_COMMAND, "fishd", *_settings)
    EXPERIMENT = (*preloaded.UNHURRIED_COMMAND, "fishctl")


class Process(processes.Process):
    """A program that runs beside this one."""

    start = staticmethod(preloaded.start)

    def stop(self) -> None:
        """Send SIGSTOP, and wait until no thread runs."""
        self.process.send_signal(signal.SIGSTOP)
        wait_until(lambda: is_stopped(self.pid))


def is_stopped(pid: int) -> bool:
    """Return whether a process is stopped by a signal."""
    return "\nState:\tT" in Path(f"/proc/{pid}/status").read_text()


def reserve_port() -> sockets.socket:
    """Return a socket that keeps a free TCP port for a fishd, until it is closed.

    Only a program that names the port can listen at it meanwhile.
    """
    reserved = sockets.socket()
    reserved.setsockopt(sockets.SOL_SOCKET, sockets.SO_REUSEADDR, 1)
    reserved.bind(("127.0.0.1", 0))
    return reserved


def addresses(folder: Path) -> list[str]:
    """Return the options for the addresses of a separate fishd."""
    return sets(f"control.address=ipc://{folder}/control", "telemetry.address=tcp://127.0.0.1:0")


def install(
    site: Path, modules: Mapping[str, str], *, group: str = "fishd.controllers", **classes: str
) -> None:
    """Install a package of controllers, or of another group, into a folder of PYTHONPATH.

    classes: name to `module:class`
    """
    package = next(iter(classes))
    info = site / f"{package}-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    lines = (f"{name} = {where}\n" for name, where in classes.items())
    (info / "entry_points.txt").write_text(f"[{group}]\n" + "".join(lines))
    for name, code in modules.items():
        (site / f"{name}.py").write_text(code)


class Daemon(Process):
    """Running fishd with separate addresses."""

    def __init__(
        self, folder: Path, *arguments: str, under: Sequence[str] = (), start: Sequence[str] = START
    ) -> None:
        """
        under: beginning of the command that starts the daemon, for example `setpriv`
        start: rest of the command
        """
        self.endpoint = f"ipc://{folder}/control"
        super().__init__(*under, *start, *addresses(folder), *arguments)

    def wait_until_up(self) -> Self:
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline and self.process.poll() is None:
            try:
                self.telemetry = self.status(timeout=0.5).telemetry
                return self
            except NoDaemon:
                time.sleep(0.02)
        raise AssertionError(f"fishd did not come up: {self.end()}")

    def status(self, timeout: float = PATIENCE) -> Status:
        with Fish(self.endpoint, timeout=timeout) as fish:
            return fish.status()

    def at_rest(self) -> Self:
        """Return the daemon in its state at the start, after any controller or emergency stop."""
        with Fish(self.endpoint, timeout=PATIENCE) as fish:
            fish.stop()
            wait_until(lambda: _rests(fish))
        return self

    def wait_until_still(self) -> None:
        """Wait until the fin of a simulated fish stands still, after any swim before the rest."""
        with Fish(self.endpoint, timeout=PATIENCE) as fish:
            ticks = fish.ticks()
            wait_until(lambda: all(abs(float(next(ticks).alpha)) < 1e-4 for _ in range(3)))  # type: ignore[arg-type]

    def fishctl(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run fishctl for this daemon, and return the result."""
        return fishctl("--endpoint", self.endpoint, *arguments)

    def fishctl_apart(self, *arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
        """Run fishctl for this daemon in a separate process, with its environment."""
        return call(FISHCTL, "--endpoint", self.endpoint, *arguments, **options)

    def socket(self, kind: int = zmq.DEALER) -> "zmq.Socket[bytes]":
        """Return a plain ZeroMQ client."""
        socket = zmq.Context.instance().socket(kind)
        socket.set(zmq.LINGER, 0)
        socket.set(zmq.RCVTIMEO, int(PATIENCE * 1000))
        socket.connect(self.endpoint)
        return socket

    def estop_socket(self) -> sockets.socket:
        """Return a plain client of fishd's socket for an emergency stop."""
        client = sockets.socket(sockets.AF_UNIX, sockets.SOCK_DGRAM)
        client.settimeout(PATIENCE)
        client.bind("")
        client.connect(self.endpoint.removeprefix("ipc://") + ".estop")
        return client


def _rests(fish: Fish) -> bool:
    fish.clear_fault()  # from the previous test, or caused by a busy machine
    status = fish.status()
    return status.mode == "idle" and status.servo_on and status.phi_c == 0.0


@contextlib.contextmanager
def running(
    folder: Path, *arguments: str, under: Sequence[str] = (), start: Sequence[str] = START
) -> Iterator[Daemon]:
    """Run a daemon that always ends with the context."""
    with Daemon(folder, *arguments, under=under, start=start) as daemon:
        try:
            yield daemon.wait_until_up()
        finally:
            print(f"fishd said:\n{daemon.end()[2]}")  # pytest shows this for a failed test


class Subscriber:
    """Plain ZeroMQ subscriber."""

    def __init__(self, address: str, topic: bytes = b"") -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self._context.socket(zmq.SUB)
        self.socket.set(zmq.SUBSCRIBE, topic)
        self.socket.set(zmq.RCVTIMEO, int(PATIENCE * 1000))
        self.socket.connect(address)

    def connected(self) -> Self:
        """Wait until ticks arrive; later messages are not missed."""
        self.socket.subscribe(b"tick")
        while self.socket.recv_multipart()[0] != b"tick":  # earlier messages
            pass
        self.socket.unsubscribe(b"tick")
        return self

    def message(self) -> dict[str, Any]:
        _, payload = self.socket.recv_multipart()
        message: dict[str, Any] = msgspec.json.decode(payload)
        return message

    def until(self, **wanted: Any) -> dict[str, Any]:
        """Return the first message in which these fields have these values."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            message = self.message()
            if all(message.get(name) == value for name, value in wanted.items()):
                return message
        raise AssertionError(f"no message with {wanted}")

    def close(self) -> None:
        self._context.destroy(linger=0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
