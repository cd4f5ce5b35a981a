"""What a simulated camera shows of a simulated fish in this process, tick by tick."""

from collections.abc import Callable

from fishd.camera.simulated.camera import SimulatedCamera, Tail
from fishd.camera.simulated.settings import SimulatedCameraSettings
from fishd.core.camera_frames import FrameHistory, Stack, StackSettings
from fishd.core.signals import Truth


class SimulatedSight:
    """Follows one fish from its first tick on; to be asked in each."""

    def __init__(
        self,
        camera: SimulatedCameraSettings,
        stack: StackSettings,
        tick: float,
        truth: Callable[[], Truth],
    ) -> None:
        """
        tick: period of the loop [s]
        truth: where the fish is now
        """
        self._camera = SimulatedCamera(camera, stack.size)
        self._history = FrameHistory(stack)
        self._tick, self._truth = tick, truth
        self._before: Tail | None = None

    def look(self, time: float) -> Stack | None:
        """The stack that a policy is shown at a tick [s]; None before there are enough frames."""
        now = self._truth()
        after = Tail(time, now.alpha, now.alpha_rate)
        before = self._before or Tail(time - self._tick, now.alpha, 0.0)
        if after.time > before.time:
            self._before = after
            for frame in self._camera.frames(before, after):
                self._history.add(frame)
        return self._history.stack(time)
