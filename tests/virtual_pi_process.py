"""Runs `fishctl virtual-pi run` as a process of its own, for a real fishd to drive."""

import json
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processes import FISHCTL, PATIENCE

PANEL = ["--set", "panel.estop_gpio=17", "--set", "panel.led_gpio=27"]
SHIPPED = str(Path(__file__).parents[1] / "config" / "virtual-pi.yaml")


class Pi:
    """A running `fishctl virtual-pi run`."""

    def __init__(self, folder: Path) -> None:
        self._place = ["--set", f"virtual_pi.socket={folder}/pi"]
        self.process = subprocess.Popen(
            [
                *(FISHCTL, "virtual-pi", "run", "--config", SHIPPED, *self._place, *PANEL),
                *("--set", "virtual_pi.pigpio_port=0"),
            ],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout
        port = self.process.stdout.readline().partition("127.0.0.1:")[2].split()[0]
        self.settings = [
            *("--config", SHIPPED, *self._place),
            *("--set", f"servo.pigpio.port={port}"),
            # Machines that run tests may stall.
            *("--set", "servo.pigpio.timeout=0.1", "--set", "servo.pigpio.countdown=2"),
            *("--set", f"state_folder={folder}"),
            *PANEL,
        ]

    def control(self, *arguments: str) -> str:
        command = [FISHCTL, "virtual-pi", *arguments, *self._place, *PANEL]
        run = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE)
        assert run.returncode == 0, run.stderr
        return run.stdout

    def pulse(self) -> float:
        found: float = json.loads(self.control("status", "--json"))["pulse"]
        return found


@contextmanager
def virtual_pi(folder: Path) -> Iterator[Pi]:
    pi = Pi(folder)
    try:
        yield pi
    finally:
        pi.process.terminate()
        pi.process.communicate(timeout=PATIENCE)
