"""A real fishd in a process of its own, its sockets and files in a folder that ends with it."""

import contextlib
import os
import signal
import socket
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
PATIENCE = 20.0
"""How long a fishd may take to start or to end [s]."""


class Fishd(Process):
    """It swings a simulated fish unless `settings`, each KEY=VALUE, say otherwise.

    A context manager; on leaving, fishd is asked to end, and killed when it does not.
    """

    def __init__(
        self,
        *settings: str,
        command: Sequence[str] = START,
        environment: dict[str, str] | None = None,
        output: int | None = None,
        tcp: bool = False,
    ) -> None:
        """
        command: what starts fishd; output: where standard output and error go, not to a log
        tcp: telemetry over TCP; another program may take the port before fishd does
        """
        self._folder = tempfile.TemporaryDirectory(prefix="fishd-")
        self.folder = Path(self._folder.name)
        self.endpoint = f"ipc://{self.folder}/control"
        self.telemetry = f"ipc://{self.folder}/telemetry"
        if tcp:
            self.telemetry = f"tcp://127.0.0.1:{_free_port()}"
        self.log = self.folder / "log"
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.set(zmq.RCVHWM, 0)  # ticks wait here, so that nobody else wakes up for them
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
            self.started = time.time()
            super().__init__(
                *command,
                *sets(*pairs),
                env={**os.environ, **(environment or {})},
                stdout=log if output is None else output,
                stderr=log if output is None else output,
            )

    def __exit__(self, *_: object) -> None:
        self.end_or_kill(PATIENCE)
        self._context.destroy(linger=0)
        self._folder.cleanup()

    def next_message(self, patience: float = PATIENCE) -> bytes:
        """Wait for what is published of a tick; raises SystemExit with fishd's log if nothing is.

        patience: how long to wait [s]
        """
        deadline = time.monotonic() + patience
        while not self._socket.poll(50):
            if time.monotonic() > deadline or self.process.poll() is not None:
                raise SystemExit(f"fishd does not tick: {self.log.read_text(encoding='utf-8')}")
        return self._socket.recv_multipart()[1]

    def waiting_messages(self) -> list[bytes]:
        """What has been published of all ticks since the last look."""
        found = []
        while self._socket.poll(0):
            found.append(self._socket.recv_multipart()[1])
        return found

    def next_tick(self, patience: float = PATIENCE) -> Tick:
        """The same as `next_message`, decoded."""
        return msgspec.json.decode(self.next_message(patience), type=Tick)

    def waiting_ticks(self) -> list[Tick]:
        """The same as `waiting_messages`, decoded."""
        return [msgspec.json.decode(message, type=Tick) for message in self.waiting_messages()]

    def status(self) -> Status:
        """What `fishctl status` gets."""
        with Fish(self.endpoint) as fish:
            return fish.status()

    def seconds_to_end(self, number: signal.Signals) -> float:
        """Send a signal; return how long the process takes to end [s]."""
        begun = time.monotonic()
        self.process.send_signal(number)
        self.process.wait(PATIENCE)
        return time.monotonic() - begun

    def gateways(self) -> list[int]:
        """Return the processes of the gateways, and first that of their fork server."""
        servers = _children(self.pid)
        return [*servers, *(pid for server in servers for pid in _children(server))]

    def gateway(self, kind: str) -> int:
        """Return the process of a gateway: `control`, `telemetry` or `gateways` for their parent.

        Waits until there is one.
        """
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            for pid in self.gateways():
                with contextlib.suppress(OSError):
                    if Path(f"/proc/{pid}/comm").read_text(encoding="ascii") == f"fishd-{kind}\n":
                        return pid
            time.sleep(0.001)
        raise SystemExit(f"fishd has no gateway of {kind}: {self.log.read_text(encoding='utf-8')}")

    def cpu_seconds(self) -> float:
        """User and system time so far, of all threads and of the gateways [s]."""
        return sum(_cpu_seconds(Path(f"/proc/{pid}")) for pid in (self.pid, *self.gateways()))

    def thread_seconds(self) -> dict[int, float]:
        """The same of each thread of fishd's own process [s]."""
        tasks = Path(f"/proc/{self.pid}/task").iterdir()
        return {int(task.name): _cpu_seconds(task) for task in tasks}

    def memory(self, field: str = "VmRSS") -> float:
        """A size of fishd's own process, of those in /proc/PID/status [MB]."""
        return _size(Path(f"/proc/{self.pid}/status"), field)

    def total_memory(self) -> float:
        """Of fishd and its gateways, pages that they share counted once (PSS) [MB]."""
        return sum(
            _size(Path(f"/proc/{pid}/smaps_rollup"), "Pss") for pid in (self.pid, *self.gateways())
        )


@contextlib.contextmanager
def virtual_pi(folder: Path) -> Iterator[tuple[VirtualPi, list[str]]]:
    """A virtual Pi in this process, and the settings of a fishd that is to swim on it."""
    settings = VirtualPiSettings(pigpio_port=0)
    pi = VirtualPi(settings, PlantParameters(), SimulationSettings(), 0.05, SystemClock())
    with LinkServer(pi, folder / "virtual-pi"):
        yield pi, virtual_pi_settings(folder / "virtual-pi", pi.pigpiod.port)


def virtual_pi_settings(address: Path, port: int) -> list[str]:
    """Those of a fishd that is to swim on a virtual Pi.

    address: the socket of the virtual Pi; port: its pigpiod's
    """
    return [
        "robot=virtual-pi",
        f"virtual_pi.socket={address}",
        f"servo.port={port}",
    ]


def _children(pid: int) -> list[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text(encoding="ascii")
    except OSError:  # it has ended
        return []
    return [int(child) for child in children.split()]


def _cpu_seconds(of: Path) -> float:
    fields = (of / "stat").read_text(encoding="ascii").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _size(file: Path, field: str) -> float:
    """[MB]; 0 once the process has ended."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except OSError:
        return 0.0
    found = (int(line.split()[1]) * 1024e-6 for line in lines if line.startswith(f"{field}:"))
    return next(found, 0.0)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
    return port
