"""Real fishd in a separate process, with its sockets and files in a temporary folder."""

import contextlib
import os
import signal
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import zmq

from common.processes import FISHD, Process, sets
from fishd.client import Fish
from fishd.core.clock import SystemClock
from fishd.core.signals import Status, Tick
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi.link_server import LinkServer
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.pi.virtual_pi import VirtualPi
from fishd.virtual.plant.parameters import PlantParameters

START = (FISHD, "--no-print-status")
TIMEOUT_S = 20.0
"""Longest time that a fishd may take to start or to end [s]."""


class Fishd(Process):
    """Real fishd with a simulated fish under `swing`, unless `settings`, each KEY=VALUE, differ.

    A context manager; at the end, fishd is terminated, and killed if it does not end.
    """

    def __init__(
        self,
        *settings: str,
        command: Sequence[str] = START,
        environment: dict[str, str] | None = None,
        output: int | None = None,
    ) -> None:
        """command: command that starts fishd; output: file for standard output and error"""
        self._folder = tempfile.TemporaryDirectory(prefix="fishd-")
        self.folder = Path(self._folder.name)
        self.endpoint = f"ipc://{self.folder}/control"
        self.telemetry = f"ipc://{self.folder}/telemetry"
        self.log = self.folder / "log"
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.set(zmq.RCVHWM, 0)  # ticks wait here, without a thread
        self._socket.set(zmq.RECONNECT_IVL, 2)
        self._socket.subscribe(b"tick")
        self._socket.connect(self.telemetry)
        own = {
            "control.address": self.endpoint,
            "telemetry.address": self.telemetry,
            "state_folder": self.folder / "state",
            "start.controller": "swing",
        }
        pairs = [*(f"{key}={value}" for key, value in own.items()), *settings]
        with self.log.open("wb") as log:
            self.started = time.monotonic()
            super().__init__(
                *command,
                *sets(*pairs),
                env={**os.environ, **(environment or {})},
                stdout=log if output is None else output,
                stderr=log if output is None else output,
            )

    def __exit__(self, *_: object) -> None:
        self.end_or_kill(TIMEOUT_S)
        self._context.destroy(linger=0)
        self._folder.cleanup()

    def next_message(self, patience: float = TIMEOUT_S) -> bytes:
        """Wait for the next message of a tick; raises SystemExit with fishd's log after a timeout.

        patience: longest wait [s]
        """
        deadline = time.monotonic() + patience
        while not self._socket.poll(50):
            if time.monotonic() > deadline or self.process.poll() is not None:
                raise SystemExit(f"fishd does not tick: {self.log.read_text(encoding='utf-8')}")
        return self._socket.recv_multipart()[1]

    def waiting_messages(self) -> list[bytes]:
        """Return the messages of all ticks since the last call."""
        messages = []
        while self._socket.poll(0):
            messages.append(self._socket.recv_multipart()[1])
        return messages

    def next_tick(self, patience: float = TIMEOUT_S) -> Tick:
        """Return the decoded result of `next_message`."""
        return msgspec.json.decode(self.next_message(patience), type=Tick)

    def waiting_ticks(self) -> list[Tick]:
        """Return the decoded results of `waiting_messages`."""
        return [msgspec.json.decode(message, type=Tick) for message in self.waiting_messages()]

    def status(self) -> Status:
        """Return the status, as `fishctl status` does."""
        with Fish(self.endpoint) as fish:
            return fish.status()

    def seconds_to_end(self, number: signal.Signals) -> float:
        """Send a signal, and return the time until the process has ended [s]."""
        begun = time.monotonic()
        self.process.send_signal(number)
        self.process.wait(TIMEOUT_S)
        return time.monotonic() - begun

    def cpu_seconds(self) -> float:
        """Return the user and system time of all threads and of the gateway [s]."""
        return sum(_cpu_seconds(Path(f"/proc/{pid}")) for pid in self.processes())

    def processes(self) -> list[int]:
        """Return the processes of fishd and of its gateways."""
        return [self.pid, *list_children(self.pid)]

    def memory(self, field: str = "VmRSS") -> float:
        """Return a size of the main process in /proc/PID/status [MB]."""
        return read_size(Path(f"/proc/{self.pid}/status"), field)

    def total_memory(self) -> float:
        """Return the memory of fishd and its gateway, shared pages counted once (PSS) [MB]."""
        return sum(read_size(Path(f"/proc/{pid}/smaps_rollup"), "Pss") for pid in self.processes())


@contextlib.contextmanager
def virtual_pi(folder: Path) -> Iterator[tuple[VirtualPi, list[str]]]:
    """Run a virtual Pi in this process; yield it and the settings of a fishd for it."""
    settings = VirtualPiSettings(pigpio_port=0)
    pi = VirtualPi(settings, PlantParameters(), SimulationSettings(), 0.05, SystemClock())
    with LinkServer(pi, folder / "virtual-pi"):
        yield pi, virtual_pi_settings(folder / "virtual-pi", pi.pigpiod.port)


def virtual_pi_settings(address: Path, port: int) -> list[str]:
    """Return the settings of a fishd on a virtual Pi.

    address: socket of the virtual Pi; port: TCP port of its pigpiod
    """
    return [
        "robot=virtual-pi",
        f"virtual_pi.socket={address}",
        f"servo.port={port}",
    ]


def list_children(pid: int) -> list[int]:
    """Return the children of a process; none after its end."""
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii")
    except OSError:  # the process has ended
        return []
    return [int(child) for child in children.split()]


def _cpu_seconds(of: Path) -> float:
    fields = (of / "stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def read_size(file: Path, field: str) -> float:
    """Return a size [MB]; 0 after the end of the process."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except OSError:
        return 0.0
    sizes = (int(line.split()[1]) * 1024e-6 for line in lines if line.startswith(f"{field}:"))
    return next(sizes, 0.0)
