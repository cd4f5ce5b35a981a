"""What tests of the operator's verbs are built from: a virtual Pi, loads on its fish, dialogues."""

import contextlib
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from multiprocessing.managers import BaseManager
from pathlib import Path
from typing import Any

from fishd.client import Fish
from fishd.core.calibration import ForceCalibration, ServoCalibration
from fishd.core.clock import SystemClock
from fishd.core.protocol import Calibrations
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.pi.ads1115 import Ads1115Chip
from fishd.virtual.pi.i2c import Write
from fishd.virtual.pi.link_server import LinkServer
from fishd.virtual.pi.settings import VirtualPiSettings
from fishd.virtual.pi.virtual_pi import VirtualPi
from fishd.virtual.plant.parameters import PlantParameters
from rigs.processes import FISHCTL, PATIENCE, Daemon, fishctl, running, sets, wait_until

SENSITIVITY_X, SENSITIVITY_Y = 2.0, 1.5
"""Of the sensor with loads on it [V/N]."""
CROSSTALK = 0.1
"""Share of the other voltage that shows on each channel."""
ZERO_X, ZERO_Y = 0.3, -0.2
"""Voltages without a load [V]."""
SERVO = 18
"""Its GPIO."""
_MUX_X, _MUX_Y = 0, 3  # A0-A1 and A2-A3


class LoadedPi:
    """A virtual Pi whose fish can be loaded; lives in a process of its own."""

    def __init__(self, socket: str) -> None:
        self._load = (0.0, 0.0)
        self._shaking = 0.0
        # Its own chip moves aside for the one that feels the loads.
        settings = VirtualPiSettings(socket=socket, pigpio_port=0, address=0x49)
        clock = SystemClock()
        self._pi = VirtualPi(
            settings, PlantParameters(), SimulationSettings(noise=2e-4), 0.05, clock
        )
        self._pi.bus.attach(0x48, Ads1115Chip(clock, self._volts, self._pi.faults))
        self._server = LinkServer(self._pi, Path(socket))
        self._server.start()

    def close(self) -> None:
        self._server.close()

    def _volts(self, mux: int, begin: float, end: float) -> float:
        x, y = self._load
        x += self._shaking * (1 if end % 0.5 < 0.25 else -1)
        vx = SENSITIVITY_X * (x + CROSSTALK * y)
        vy = SENSITIVITY_Y * (y + CROSSTALK * x)
        fish = self._pi.tank.volts(mux, begin, end)
        return {_MUX_X: vx + ZERO_X, _MUX_Y: vy + ZERO_Y}[mux] + fish

    def load(self, fx: float, fy: float, shaking: float = 0.0) -> None:
        """Pull at the fish [N], with a force along x that comes and goes, ±shaking."""
        self._load, self._shaking = (fx, fy), shaking

    def write_register(self, register: int, value: int) -> None:
        """Do to the chip what another program might."""
        self._pi.bus.transfer(0x48, [Write(bytes([register, *value.to_bytes(2, "big")]))])

    def inject(self, fault: str) -> None:
        self._pi.faults.inject(fault)

    def clear(self) -> None:
        self._pi.faults.clear()

    def port(self) -> int:
        return self._pi.pigpiod.port

    def pulse(self) -> float:
        """The servo pulse now [µs]; 0 for none."""
        return self._pi.pigpiod.width(SERVO, time.monotonic())

    def widths(self) -> list[float]:
        """The pulses that the servo has got, one after the other [µs]."""
        return [width for _, width in self._pi.pigpiod.history(SERVO)]


class _Manager(BaseManager):
    pass


_Manager.register("LoadedPi", LoadedPi)


def _be_prompt() -> None:
    """fishd gives pigpiod a few milliseconds; the real one has a priority of its own, too."""
    sys.setswitchinterval(2e-4)
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))


class Bench:
    """A virtual Pi that other processes reach, and what they have to be told about it."""

    def __init__(self, folder: Path, pi: Any) -> None:
        """pi: a `LoadedPi`, in its process"""
        self.folder = folder
        self.pi = pi
        self._port = pi.port()

    @property
    def settings(self) -> list[str]:
        """Options for a fishd, or a verb, that is to use this virtual Pi."""
        return sets(
            "robot=virtual-pi",
            f"virtual_pi.socket={self.folder}/virtual-pi",
            f"servo.port={self._port}",
            "servo.timeout=0.1",  # machines that run tests may stall
            "servo.countdown=2",
            f"state_folder={self.folder}/state",
            "force_sensor.tare_limit=0.5",
            "force_sensor.data_rate=64",  # enough for them, and a fifth of the work
        )

    def files(self, kind: str) -> list[Path]:
        """Calibration files, oldest first."""
        return sorted((self.folder / "state" / "virtual-pi").glob(f"{kind}-*.yaml"))

    def wait_for_pulse(self, lowest: float, highest: float) -> None:
        """Until the pulse is within these [µs]."""
        wait_until(lambda: lowest <= self.pi.pulse() <= highest)

    def daemon(self, *arguments: str) -> AbstractContextManager[Daemon]:
        """A fishd on this virtual Pi."""
        return running(self.folder, *self.settings, *arguments)

    def renew(self, daemon: Daemon) -> None:
        """Take away loads, faults and calibrations, and bring its fishd to rest."""
        self.pi.load(0.0, 0.0)
        self.pi.clear()
        wait_until(lambda: not daemon.status().sensor_lost)
        daemon.at_rest()
        with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
            wait_until(lambda: not fish.status().calibrating)
            fish.calibrate_force(ForceCalibration())
            fish.calibrate_servo(ServoCalibration(), save=True)
        for kind in ("force", "servo"):
            for file in self.files(kind):
                file.unlink()


@contextlib.contextmanager
def pi_process() -> Iterator[Any]:
    """A process in which a `LoadedPi` can be made, one after the other."""
    manager = _Manager(ctx=multiprocessing.get_context("spawn"))
    manager.start(initializer=_be_prompt)
    try:
        yield manager
    finally:
        manager.shutdown()


@contextlib.contextmanager
def bench(process: Any, folder: Path) -> Iterator[Bench]:
    """A virtual Pi that runs as long as this, in a `pi_process`."""
    pi = process.LoadedPi(str(folder / "virtual-pi"))
    try:
        yield Bench(folder, pi)
    finally:
        pi.close()


class Dialogue:
    """A `fishctl` whose prompts are answered one by one."""

    def __init__(self, daemon: Daemon, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [FISHCTL, "--endpoint", daemon.endpoint, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        assert self.process.stdout
        assert self.process.stdin
        self._out = self.process.stdout.fileno()
        self._in = self.process.stdin.fileno()
        os.set_blocking(self._out, False)
        self.text = ""
        self._seen = 0

    def close(self) -> None:
        """End it, whatever it is doing; may be called after `finish`."""
        self.process.kill()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe:
                pipe.close()
        self.process.wait(PATIENCE)

    def expect(self, text: str) -> str:
        """Wait until this turns up in what is new; returns all that is new up to there."""
        deadline = time.monotonic() + PATIENCE
        while text not in self.text[self._seen :]:
            assert time.monotonic() < deadline, f"no '{text}' in: {self.text}"
            try:
                chunk = os.read(self._out, 65536)
            except BlockingIOError:
                time.sleep(0.01)
                continue
            assert chunk, f"it ended without '{text}': {self.text}"
            self.text += chunk.decode()
        before = self._seen
        self._seen = self.text.index(text, before) + len(text)
        return self.text[before : self._seen]

    def answer(self, prompt: str, line: str = "") -> str:
        """Wait for a prompt and type a line; returns what came before it."""
        shown = self.expect(prompt)
        os.write(self._in, f"{line}\n".encode())
        return shown

    def finish(self) -> int:
        """Close its input and wait for its end; returns the exit status."""
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.close()
        os.set_blocking(self._out, True)
        self.text += self.process.stdout.read().decode()
        self.process.stdout.close()
        return self.process.wait(PATIENCE)


Talk = Callable[..., Dialogue]
"""Begins a `Dialogue` with a fishctl that is gone after the test."""


def forces(daemon: Daemon, seconds: float = 0.6) -> tuple[float, float]:
    """F_x and F_y as the daemon measures them now [N]."""
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        sample = fish.sample_force(seconds)
    return sample.fx, sample.fy


def calibrations(daemon: Daemon) -> Calibrations:
    """What fishd uses now."""
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        return fish.calibrations()


def fishctl_alone(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """fishctl where no daemon runs."""
    return fishctl("--endpoint", f"ipc://{folder}/nobody", *arguments)
