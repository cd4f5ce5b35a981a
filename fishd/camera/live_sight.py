"""What a running `fishd-camera` shows a policy; refuses a camera that does not suit it."""

import math
import time
from typing import Self

from fishd.camera.client import CameraClient, CameraLost
from fishd.client import Fish
from fishd.core.camera_frames import Stack, StackSettings
from fishd.core.errors import PolicyError

FIRST_FRAMES = 5.0
"""How long a camera may take until it has shown enough to be judged [s]."""
ENOUGH = 10
"""Frames by which its rate is judged."""
_SHARE = 0.8
"""Of the rate that a stack needs: so much less is still good."""


class LiveSight:
    """The stacks that one policy is shown, and whether they fit it; a context manager."""

    def __init__(self, endpoint: str | None, fish: Fish, stack: StackSettings) -> None:
        """
        endpoint: where the camera takes requests; None: as for `CameraClient`
        fish: the fishd that swims
        stack: what the policy is to be shown

        Raises `CameraLost` where no camera answers, and `PolicyError` where its frames have another
        size.
        """
        self._lockstep = bool(fish.config()["lockstep"])
        self._stack = stack
        self._client = CameraClient(endpoint, fish=fish, stack=stack)
        self._judged = False
        self._begun = time.monotonic()
        size = self._client.state.width
        if size != stack.size:
            self.close()
            raise PolicyError(
                f"frames of {stack.size} x {stack.size} pixels are needed (camera.stack.size), the "
                f"camera at {self._client.endpoint} shows {size} x {size}; start it with --set "
                f"picture.size={stack.size}"
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._client.close()

    def await_frames(self) -> None:
        """Wait until the camera has shown enough, before anything moves; not in lockstep.

        There, time stands still until the fish swims. Raises `CameraLost`, and `PolicyError` where
        frames come too seldom or too late.
        """
        if self._lockstep:
            return
        seen = 0
        deadline = time.monotonic() + FIRST_FRAMES
        while seen < ENOUGH and time.monotonic() < deadline:
            seen += len(self._client.poll(0.1))
        if not seen:
            raise self.lost()
        self._judge()

    def look(self, tick: float) -> Stack | None:
        """The stack for the tick at `tick` [s, clock of fishd]; None where the camera lags behind.

        Raises `PolicyError` as `await_frames` does, and in lockstep `CameraLost`.
        """
        if self._lockstep:
            followed = self._client.state.virtual
            try:
                found = self._client.stack_at(tick)
            except CameraLost:
                if followed:
                    raise
                return None  # it does not follow this fishd yet, which has not ticked for it
            if not self._judged and self._client.state.seq >= ENOUGH:
                self._judge()
            return found
        self.listen()
        return self._client.history.stack(tick)

    def listen(self) -> None:
        """Take the frames that have come, so that none pile up."""
        while self._client.poll():
            pass

    def lost(self) -> CameraLost:
        """Why no frames come; it may take a while to find out."""
        try:
            self._client.check()
            state = self._client.status()
            self._judge()
        except CameraLost as error:
            return error
        except PolicyError as error:
            return CameraLost(str(error))
        why = f": {state.problem}" if state.problem else ""
        return CameraLost(
            f"the camera at {self._client.endpoint} is {state.state}, but has shown no whole stack "
            f"of frames{why}"
        )

    def _judge(self) -> None:
        """Raise `PolicyError` where frames come too seldom or too late for this policy."""
        self._judged = True
        state, stack = self._client.status(), self._stack
        camera = f"the camera at {self._client.endpoint}"
        if stack.frames > 1 and 0.0 < state.rate < _SHARE / stack.interval:
            raise PolicyError(
                f"{1.0 / stack.interval:.3g} frames a second are needed, as those that are shown "
                f"are {stack.interval * 1e3:g} ms apart (camera.stack.interval); {camera} gives "
                f"{state.rate:.3g} a second: a faster camera is needed, or a training with "
                f"camera.stack.interval: {_rounded_up(_SHARE / state.rate):g}"
            )
        if not state.rate or state.latency is None:
            return
        late = state.latency + 1.0 / state.rate
        if late > stack.delay + stack.oldest:
            raise PolicyError(
                f"frames no older than {(stack.delay + stack.oldest) * 1e3:.0f} ms are needed "
                f"(camera.stack.delay + oldest); those of {camera} are there "
                f"{state.latency * 1e3:.0f} ms after their exposure, {1e3 / state.rate:.0f} ms "
                "apart: a camera with less latency is needed, or a training with "
                f"camera.stack.delay: {_rounded_up(max(state.latency, late - stack.oldest)):g}"
            )


def _rounded_up(seconds: float) -> float:
    """To 5 ms."""
    return round(math.ceil(seconds / 5e-3 - 1e-6) * 5e-3, 3)
