"""The real loop and the real drivers on a virtual Pi, all of it in virtual time."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from harness import Recorder

from fishd.build import build_loop
from fishd.clock import Slot, VirtualClock
from fishd.config import load
from fishd.controllers import registry
from fishd.controllers.base import Controller
from fishd.robots import open_in_virtual_time
from fishd.signals import Tick

GPIO = 18
NEUTRAL = 1500.0


class LockstepRig:
    """A loop on the whole hardware path, and the virtual Pi for a test to break."""

    def __init__(self, folder: Path, stack: ExitStack, *overrides: str) -> None:
        self.config = load(None, ["robot=virtual-pi", f"state_folder={folder}", *overrides])
        self.clock = VirtualClock()
        self.robot, self.pi = open_in_virtual_time(self.config, stack)
        self.recorder = Recorder()
        self.loop = build_loop(self.config, self.robot, self.clock, self.recorder)
        self.index = 0

    @property
    def now(self) -> float:
        """The latest deadline [s]."""
        return (self.index - 1) * self.config.tick

    @property
    def mode(self) -> str:
        return self.loop.supervisor.mode.value

    @property
    def reason(self) -> str | None:
        reason = self.loop.supervisor.reason
        return reason.code if reason else None

    @property
    def pulse(self) -> float:
        """What the servo gets now [µs]; 0 for no pulses."""
        return self.pi.pigpiod.width(GPIO, self.now)

    def start(self, controller: str | Controller[Any], **parameters: Any) -> None:
        if isinstance(controller, str):
            made = registry.create(controller, parameters, self.config.limits)
            self.loop.set_controller(controller, made)
        else:
            self.loop.set_controller(type(controller).__name__.lower(), controller)

    def run_for(self, seconds: float) -> list[Tick]:
        ticks = round(seconds / self.config.tick)
        for _ in range(ticks):
            deadline = self.index * self.config.tick
            self.clock.now = deadline
            self.loop.tick(Slot(self.index, deadline, deadline, 0))
            self.index += 1
        return self.recorder.ticks[-ticks:]

    def run_until_fault(self, limit: float) -> float:
        """How long it took [s]."""
        begun = self.now
        while self.mode != "fault":
            assert self.now - begun < limit, f"still {self.mode} after {limit} s"
            self.run_for(self.config.tick)
        return self.now - begun

    def pulses_since(self, time: float) -> list[tuple[float, float]]:
        """(time, width) of every change of the pulses from `time` on."""
        history = self.pi.pigpiod.history(GPIO)
        return [(when, width) for when, width in history if when >= time]


@contextmanager
def lockstep_rig(folder: Path, *overrides: str) -> Iterator[LockstepRig]:
    with ExitStack() as stack:
        yield LockstepRig(folder, stack, *overrides)
