"""What tests of the operator's verbs are built from: a virtual Pi, loads on its fish, dialogues."""

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processes import FISHCTL, PATIENCE, Daemon, running

from fishd.clock import SystemClock
from fishd.emulation.ads1115 import Ads1115Chip
from fishd.emulation.link_server import LinkServer
from fishd.emulation.settings import VirtualPiSettings
from fishd.emulation.virtual_pi import VirtualPi
from fishd.hardware.imperfections import SimulationSettings
from fishd.plant.parameters import PlantParameters

SENSITIVITY_X, SENSITIVITY_Y = 2.0, 1.5
"""Of the sensor with loads on it [V/N]."""
CROSSTALK = 0.1
"""Share of the other voltage that shows on each channel."""
ZERO_X, ZERO_Y = 0.3, -0.2
"""Voltages without a load [V]."""
_MUX_X, _MUX_Y = 0, 3  # A0-A1 and A2-A3


class Bench:
    """A virtual Pi that other processes reach, whose fish can be loaded, and fishctl for it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.load = (0.0, 0.0)
        """Force on the fish [N]."""
        self.shaking = 0.0
        """Amplitude of a force that comes and goes [N]."""
        socket = folder / "virtual-pi"
        # Its own chip moves aside for the one that feels the loads.
        settings = VirtualPiSettings(socket=str(socket), pigpio_port=0, address=0x49)
        clock = SystemClock()
        self.pi = VirtualPi(settings, PlantParameters(), SimulationSettings(), 0.05, clock)
        self.pi.bus.attach(0x48, Ads1115Chip(clock, self._volts, self.pi.faults))
        self.server = LinkServer(self.pi, socket)

    def _volts(self, mux: int, begin: float, end: float) -> float:
        x, y = self.load
        x += self.shaking * (1 if end % 0.5 < 0.25 else -1)
        vx = SENSITIVITY_X * (x + CROSSTALK * y)
        vy = SENSITIVITY_Y * (y + CROSSTALK * x)
        fish = self.pi.tank.volts(mux, begin, end)
        return {_MUX_X: vx + ZERO_X, _MUX_Y: vy + ZERO_Y}[mux] + fish

    @property
    def settings(self) -> list[str]:
        """Options for a fishd, or a verb, that is to use this virtual Pi."""
        pairs = {
            "robot": "virtual-pi",
            "virtual_pi.socket": self.folder / "virtual-pi",
            "servo.pigpio.port": self.pi.pigpiod.port,
            "state_folder": self.folder / "state",
            "force_sensor.tare_limit": 0.5,
        }
        return [word for key, value in pairs.items() for word in ("--set", f"{key}={value}")]

    @property
    def pulse(self) -> float:
        """The servo pulse now [µs]; 0 for none."""
        return self.pi.pigpiod.width(18, time.monotonic())

    def files(self, kind: str) -> list[Path]:
        """Calibration files, oldest first."""
        return sorted((self.folder / "state" / "virtual-pi").glob(f"{kind}-*.yaml"))

    def wait_for_pulse(self, lowest: float, highest: float) -> None:
        """Until the pulse is within these [µs]."""
        deadline = time.monotonic() + PATIENCE
        while not lowest <= self.pulse <= highest:
            assert time.monotonic() < deadline, f"the pulse is {self.pulse} µs"
            time.sleep(0.01)

    @contextmanager
    def daemon(self, *arguments: str) -> Iterator[Daemon]:
        """A fishd on this virtual Pi."""
        with running(self.folder, *self.settings, *arguments) as daemon:
            yield daemon


@contextmanager
def bench(folder: Path) -> Iterator[Bench]:
    """A virtual Pi that runs in this process."""
    found = Bench(folder)
    with found.server:
        yield found


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
