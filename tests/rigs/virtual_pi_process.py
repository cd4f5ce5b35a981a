"""Runs `fishctl virtual-pi run` as a process of its own, for a real fishd to drive."""

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
    """A running `fishctl virtual-pi run`."""

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
        found = re.search(r"pigpiod on 127.0.0.1:(\d+)", self.greeting)
        assert found, self.end()
        self.port = int(found[1])
        return self

    @property
    def settings(self) -> list[str]:
        """What a fishd on this virtual Pi has to be told; machines that run tests may stall."""
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
        found: float = json.loads(self.control("status", "--json"))["pulse"]
        return found

    def wait_until_released(self) -> None:
        """Until there are no pulses: a frame that has begun is sent to its end."""
        wait_until(lambda: not self.pulse())


@contextmanager
def virtual_pi(folder: Path, *settings: str) -> Iterator[Pi]:
    pi = Pi(folder, *settings)
    try:
        yield pi.wait_until_up()
    finally:
        pi.end()
