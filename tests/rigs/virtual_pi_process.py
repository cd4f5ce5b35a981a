"""`fishctl virtual-pi run` as a separate process, for a real fishd."""

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import CompletedProcess
from typing import Self

from rigs.processes import FISHCTL, Process, fishctl, sets, wait_until

PANEL = ("panel.estop_gpio=17", "panel.led_gpio=27")
SHIPPED = str(Path(__file__).parents[2] / "config" / "virtual-pi.yaml")


class Pi(Process):
    """Running `fishctl virtual-pi run`."""

    def __init__(self, folder: Path, *settings: str) -> None:
        self.folder = folder
        self.path = folder / "pi"
        place = f"virtual_pi.socket={self.path}"
        self._options = ["--config", SHIPPED]
        self._options += sets(place, "virtual_pi.pigpio_port=0", *PANEL, *settings)
        super().__init__(FISHCTL, "virtual-pi", "run", *self._options)

    def wait_until_up(self) -> Self:
        assert self.process.stdout
        self.greeting = self.process.stdout.readline()
        match = re.search(r"pigpiod on 127.0.0.1:(\d+)", self.greeting)
        assert match, self.end()
        self.port = int(match[1])
        return self

    @property
    def settings(self) -> list[str]:
        """Return the settings of a fishd on this virtual Pi, for machines that may stall."""
        servo = (f"port={self.port}", "timeout=0.1", "countdown=2")
        own = sets(*(f"servo.{pair}" for pair in servo), f"state_folder={self.folder}")
        return [*self._options, *own]

    def fishctl(self, *arguments: str) -> CompletedProcess[str]:
        return fishctl("virtual-pi", *arguments, *self._options)

    def control(self, *arguments: str) -> str:
        done = self.fishctl(*arguments)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout

    def pulse(self) -> float:
        pulse: float = json.loads(self.control("status", "--json"))["pulse"]
        return pulse

    def wait_until_released(self) -> None:
        """Wait until the pulses have ended; a running frame is completed."""
        wait_until(lambda: not self.pulse())


@contextmanager
def virtual_pi(folder: Path, *settings: str) -> Iterator[Pi]:
    pi = Pi(folder, *settings)
    try:
        yield pi.wait_until_up()
    finally:
        pi.end()
