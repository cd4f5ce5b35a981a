"""Real loop and real drivers on a virtual Pi, in virtual time."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from fishd.assembly import open_in_virtual_time
from fishd.hardware.base import Robot
from rigs.harness import Rig

GPIO = 18
NEUTRAL = 1500.0


class LockstepRig(Rig):
    """Loop on the whole hardware path, with a virtual Pi that a test can break."""

    robot_name = "virtual-pi"

    def __init__(self, folder: Path, stack: ExitStack, *overrides: str) -> None:
        own = (f"robot={self.robot_name}", f"state_folder={folder}")
        super().__init__(*own, *overrides, stack=stack)

    def open_robot(self, stack: ExitStack) -> Robot:
        robot, self.pi = open_in_virtual_time(self.config, stack)
        return robot

    @property
    def pulse(self) -> float:
        """Return the current servo pulse [µs]; 0 without pulses."""
        return self.pi.pigpiod.width(GPIO, self.now)

    def run_until_fault(self, limit: float) -> float:
        """Run until a fault, and return the time [s]."""
        begun = self.now
        while self.mode != "fault":
            assert self.now - begun < limit, f"still {self.mode} after {limit} s"
            self.run()
        return self.now - begun

    def pulses_since(self, time: float) -> list[tuple[float, float]]:
        """Return time and width of every change of the pulses from `time` on."""
        history = self.pi.pigpiod.history(GPIO)
        return [(when, width) for when, width in history if when >= time]


@contextmanager
def lockstep_rig(folder: Path, *overrides: str) -> Iterator[LockstepRig]:
    with ExitStack() as stack:
        yield LockstepRig(folder, stack, *overrides)
