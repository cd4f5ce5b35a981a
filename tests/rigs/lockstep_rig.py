"""The real loop and the real drivers on a virtual Pi, all of it in virtual time."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from fishd.assembly import open_in_virtual_time
from fishd.hardware.base import Robot
from rigs.harness import Rig

GPIO = 18
NEUTRAL = 1500.0


class LockstepRig(Rig):
    """A loop on the whole hardware path, and the virtual Pi for a test to break."""

    robot_name = "virtual-pi"

    def __init__(self, folder: Path, stack: ExitStack, *overrides: str) -> None:
        own = (f"robot={self.robot_name}", f"state_folder={folder}")
        super().__init__(*own, *overrides, stack=stack)

    def open_robot(self, stack: ExitStack) -> Robot:
        robot, self.pi = open_in_virtual_time(self.config, stack)
        return robot

    @property
    def pulse(self) -> float:
        """What the servo gets now [µs]; 0 for no pulses."""
        return self.pi.pigpiod.width(GPIO, self.now)

    def run_until_fault(self, limit: float) -> float:
        """How long it took [s]."""
        begun = self.now
        while self.mode != "fault":
            assert self.now - begun < limit, f"still {self.mode} after {limit} s"
            self.run()
        return self.now - begun

    def pulses_since(self, time: float) -> list[tuple[float, float]]:
        """(time, width) of every change of the pulses from `time` on."""
        history = self.pi.pigpiod.history(GPIO)
        return [(when, width) for when, width in history if when >= time]


@contextmanager
def lockstep_rig(folder: Path, *overrides: str) -> Iterator[LockstepRig]:
    with ExitStack() as stack:
        yield LockstepRig(folder, stack, *overrides)
