"""Virtual Pi, loads on its fish, and dialogues, for tests of the operator's verbs."""

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
"""Sensitivities of the loaded sensor [V/N]."""
CROSSTALK = 0.1
"""Fraction of the other voltage on each channel."""
ZERO_X, ZERO_Y = 0.3, -0.2
"""Voltages without a load [V]."""
SERVO = 18
"""GPIO of the servo."""
_MUX_X, _MUX_Y = 0, 3  # A0-A1 and A2-A3


class LoadedPi:
    """Virtual Pi whose fish can be loaded, in a separate process."""

    def __init__(self, socket: str, bits: int = 16) -> None:
        """bits: 16 for an ADS1115, 12 for an ADS1015"""
        self._load = (0.0, 0.0)
        self._shaking = 0.0
        # Replace its chip by the one with the loads.
        settings = VirtualPiSettings(socket=socket, pigpio_port=0, address=0x49)
        clock = SystemClock()
        simulation = SimulationSettings(noise=2e-4)
        self._pi = VirtualPi(settings, PlantParameters(), simulation, 0.05, clock)
        self._pi.bus.attach(0x48, Ads1115Chip(clock, self._volts, self._pi.faults, bits=bits))
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
        """Load the fish [N], with an additional alternating force along x, ±shaking."""
        self._load, self._shaking = (fx, fy), shaking

    def write_register(self, register: int, value: int) -> None:
        """Write a register of the chip, like another program."""
        self._pi.bus.transfer(0x48, [Write(bytes([register, *value.to_bytes(2, "big")]))])

    def inject(self, fault: str) -> None:
        self._pi.faults.inject(fault)

    def clear(self) -> None:
        self._pi.faults.clear()

    def port(self) -> int:
        return self._pi.pigpiod.port

    def pulse(self) -> float:
        """Return the current servo pulse [µs]; 0 without pulses."""
        return self._pi.pigpiod.width(SERVO, time.monotonic())

    def widths(self) -> list[float]:
        """Return all widths of the servo pulses, in their order [µs]."""
        return [width for _, width in self._pi.pigpiod.history(SERVO)]


class _Manager(BaseManager):
    pass


_Manager.register("LoadedPi", LoadedPi)


def _be_prompt() -> None:
    """Raise the priority, because fishd gives pigpiod only a few milliseconds."""
    sys.setswitchinterval(2e-4)
    with contextlib.suppress(PermissionError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(20))


class Bench:
    """Virtual Pi for other processes, and the settings that they need."""

    def __init__(self, folder: Path, pi: Any) -> None:
        """pi: `LoadedPi` in its process"""
        self.folder = folder
        self.pi = pi
        self._port = pi.port()

    @property
    def settings(self) -> list[str]:
        """Options of a fishd, or a verb, for this virtual Pi."""
        return sets(
            "robot=virtual-pi",
            f"virtual_pi.socket={self.folder}/virtual-pi",
            f"servo.port={self._port}",
            "servo.timeout=0.1",  # machines that run tests may stall
            "servo.countdown=2",
            f"state_folder={self.folder}/state",
            "force_sensor.tare_limit=0.5",
            "force_sensor.data_rate=64",  # sufficient, with a fifth of the load
        )

    def files(self, kind: str) -> list[Path]:
        """Return the calibration files, oldest first."""
        return sorted((self.folder / "state" / "virtual-pi").glob(f"{kind}-*.yaml"))

    def wait_for_pulse(self, lowest: float, highest: float) -> None:
        """Wait until the pulse is within these limits [µs]."""
        wait_until(lambda: lowest <= self.pi.pulse() <= highest)

    def daemon(self, *arguments: str) -> AbstractContextManager[Daemon]:
        """Run a fishd on this virtual Pi."""
        return running(self.folder, *self.settings, *arguments)

    def renew(self, daemon: Daemon) -> None:
        """Remove loads, faults and calibrations, and bring its fishd to rest."""
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
    """Run a process in which `LoadedPi`s can be created one after another."""
    manager = _Manager(ctx=multiprocessing.get_context("spawn"))
    manager.start(initializer=_be_prompt)
    try:
        yield manager
    finally:
        manager.shutdown()


@contextlib.contextmanager
def bench(process: Any, folder: Path, *options: Any) -> Iterator[Bench]:
    """Run a virtual Pi in a `pi_process`; options: those of `LoadedPi`."""
    pi = process.LoadedPi(str(folder / "virtual-pi"), *options)
    try:
        yield Bench(folder, pi)
    finally:
        pi.close()


class Dialogue:
    """Running `fishctl` whose prompts are answered one by one."""

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
        """End the program; may be called after `finish`."""
        self.process.kill()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe:
                pipe.close()
        self.process.wait(PATIENCE)

    def expect(self, text: str) -> str:
        """Wait for a text in the new output, and return the new output up to it."""
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
        """Wait for a prompt and type a line; return the output before it."""
        shown = self.expect(prompt)
        os.write(self._in, f"{line}\n".encode())
        return shown

    def finish(self) -> int:
        """Close its input and wait for its end; return the exit status."""
        assert self.process.stdin
        assert self.process.stdout
        self.process.stdin.close()
        os.set_blocking(self._out, True)
        self.text += self.process.stdout.read().decode()
        self.process.stdout.close()
        return self.process.wait(PATIENCE)


Talk = Callable[..., Dialogue]
"""Function that starts a `Dialogue` with a fishctl that ends with the test."""


def forces(daemon: Daemon, seconds: float = 0.6) -> tuple[float, float]:
    """Return the current F_x and F_y of the daemon [N]."""
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        sample = fish.sample_force(seconds)
    return sample.fx, sample.fy


def calibrations(daemon: Daemon) -> Calibrations:
    """Return the active calibrations of fishd."""
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        return fish.calibrations()


def fishctl_alone(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run fishctl without a daemon."""
    return fishctl("--endpoint", f"ipc://{folder}/nobody", *arguments)
