"""Stacks of frames of a simulated camera above a simulated fish in this process."""

from collections.abc import Callable

from fishd.camera.simulated.camera import SimulatedCamera, Tail
from fishd.camera.simulated.settings import SimulatedCameraSettings
from fishd.core.camera_frames import FrameHistory, Stack, StackSettings
from fishd.core.signals import Truth


class SimulatedSight:
    """Simulated camera above one fish; call `look` in every tick from the first one on."""

    def __init__(
        self,
        camera: SimulatedCameraSettings,
        stack: StackSettings,
        tick: float,
        truth: Callable[[], Truth],
    ) -> None:
        """
        tick: period of the loop [s]
        truth: returns the current state of the fish
        """
        self._camera = SimulatedCamera(camera, stack.size)
        self._history = FrameHistory(stack)
        self._tick, self._truth = tick, truth
        self._before: Tail | None = None

    def look(self, time: float) -> Stack | None:
        """Return the stack for a policy at a tick [s]; None before there are enough frames."""
        now = self._truth()
        after = Tail(time, now.alpha, now.alpha_rate)
        before = self._before or Tail(time - self._tick, now.alpha, 0.0)
        if after.time > before.time:
            self._before = after
            for frame in self._camera.frames(before, after):
                self._history.add(frame)
        return self._history.stack(time)
