"""Stacks of frames for a policy from a running `fishd-camera`; refuses an unsuitable camera."""

import math
import time
from typing import Self

from fishd.camera.client import CameraClient, CameraLost
from fishd.client import Fish
from fishd.core.camera_frames import Stack, StackSettings
from fishd.core.errors import PolicyError

FIRST_FRAMES_TIMEOUT_S = 5.0
"""Longest wait for the frames from which a camera is checked [s]."""
MIN_CHECKED_FRAMES = 10
"""Number of frames from which the camera's rate is checked."""
_MIN_RATE_FRACTION = 0.8
"""Smallest usable rate of a camera, as a fraction of the rate that a stack needs."""


class LiveSight:
    """Source of the stacks for one policy, which checks the camera; a context manager."""

    def __init__(self, endpoint: str | None, fish: Fish, stack: StackSettings) -> None:
        """
        endpoint: address of the camera's requests; None: as for `CameraClient`
        fish: the fishd that swims
        stack: the frames that the policy needs

        Raises `CameraLost` where no camera answers, and `PolicyError` where its frames have another
        size.
        """
        self._lockstep = bool(fish.config()["lockstep"])
        self._stack = stack
        self._client = CameraClient(endpoint, fish=fish, stack=stack)
        self._checked = False
        self._start = time.monotonic()
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
        """Wait until enough frames have arrived, and check them, before the fish moves.

        In lockstep, return at once, because time stands still until the fish swims. Raises
        `CameraLost`, and `PolicyError` where frames are too infrequent or too late.
        """
        if self._lockstep:
            return
        received = 0
        deadline = time.monotonic() + FIRST_FRAMES_TIMEOUT_S
        while received < MIN_CHECKED_FRAMES and time.monotonic() < deadline:
            received += len(self._client.poll(0.1))
        if not received:
            raise self.lost()
        self._check()

    def look(self, tick: float) -> Stack | None:
        """Return the stack for the tick at `tick` [s, clock of fishd]; None without enough frames.

        Raises `PolicyError` as `await_frames` does, and in lockstep `CameraLost`.
        """
        if self._lockstep:
            was_virtual = self._client.state.virtual
            try:
                frames = self._client.stack_at(tick)
            except CameraLost:
                if was_virtual:
                    raise
                return None  # the camera does not follow this fishd yet, which has not ticked since
            if not self._checked and self._client.state.seq >= MIN_CHECKED_FRAMES:
                self._check()
            return frames
        self.listen()
        return self._client.history.stack(tick)

    def listen(self) -> None:
        """Take the frames that have arrived, so that they do not accumulate."""
        while self._client.poll():
            pass

    def lost(self) -> CameraLost:
        """Return the error that says why no frames arrive; this may wait for the camera."""
        try:
            self._client.check()
            state = self._client.status()
            self._check()
        except CameraLost as error:
            return error
        except PolicyError as error:
            return CameraLost(str(error))
        problem = f": {state.problem}" if state.problem else ""
        return CameraLost(
            f"the camera at {self._client.endpoint} is {state.state}, but has shown no whole stack "
            f"of frames{problem}"
        )

    def _check(self) -> None:
        """Raise `PolicyError` where frames are too infrequent or too late for this policy."""
        self._checked = True
        state, stack = self._client.status(), self._stack
        camera = f"the camera at {self._client.endpoint}"
        if stack.frames > 1 and 0.0 < state.rate < _MIN_RATE_FRACTION / stack.interval:
            raise PolicyError(
                f"{1.0 / stack.interval:.3g} frames a second are needed, as those that are shown "
                f"are {stack.interval * 1e3:g} ms apart (camera.stack.interval); {camera} gives "
                f"{state.rate:.3g} a second: a faster camera is needed, or a training with "
                f"camera.stack.interval: {_rounded_up(_MIN_RATE_FRACTION / state.rate):g}"
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
    """Return a time rounded up to 5 ms [s]."""
    return round(math.ceil(seconds / 5e-3 - 1e-6) * 5e-3, 3)
