"""Feed of the page: a thread that receives the camera's pictures and state."""

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec

from fishd.camera.axis import AxisWatch
from fishd.camera.client import CameraClient
from fishd.core.errors import FishError

STATE_PERIOD_S = 0.5
"""Time between two updates of the state without pictures [s]."""


class News(NamedTuple):
    """Update for the page."""

    facts: bytes
    """State, rate, age, losses and axis, as one JSON object."""
    jpeg: bytes | None
    """New picture; None if there is none."""


class Feed:
    """Source of updates for the page; run `run` in a separate thread."""

    def __init__(self, address: str | None, tell: Callable[[News], None]) -> None:
        """
        address: address of the camera's requests; None: as for `CameraClient`
        tell: receives each update, in the thread of `run`

        Raises `CameraLost` where no camera answers.
        """
        self._client = CameraClient(address, views=True)
        self._watch = AxisWatch()
        self._tell = tell
        self._last_frame_time = self._last_update = time.monotonic()
        self._stopping = threading.Event()
        self._lost = ""

    def run(self) -> None:
        """Follow the camera, also after it restarts, until `stop` is called."""
        try:
            shown = None
            while not self._stopping.is_set():
                frames = self._client.poll(0.1)
                now = time.monotonic()
                for frame in frames:
                    self._watch.add(frame)
                    self._last_frame_time, self._lost = now, ""
                if self._watch.due:
                    self._watch.find()
                view = self._client.view
                if view is not None and view is not shown:
                    shown, self._last_update = view, now
                    self._tell(News(self._facts(), view.jpeg))
                elif now - self._last_update > STATE_PERIOD_S:
                    self._last_update = now
                    self._check()
                    self._tell(News(self._facts(), None))
        finally:
            self.close()

    def stop(self) -> None:
        """Request the end of `run`."""
        self._stopping.set()

    def close(self) -> None:
        """Disconnect from the camera if `run` was not called; `run` disconnects at its end."""
        self._client.close()

    def _check(self) -> None:
        try:
            self._client.check()
        except FishError as error:
            self._lost = str(error)
            # Limit the requests to one a second, because each waits for an answer.
            self._stopping.wait(1.0)

    def _facts(self) -> bytes:
        client, watch = self._client, self._watch
        state, latest, view = client.state, client.latest, client.view
        facts: dict[str, Any] = {
            "state": "lost" if self._lost else state.state,
            "problem": self._lost or state.problem,
            "remedy": "" if self._lost else state.remedy,
            "device": state.device,
            "rate": state.rate,
            "moving": watch.moving,
            "missed": client.missed,
        }
        if latest is not None:
            header = latest.header
            facts |= {
                "seq": header.seq,
                "size": header.height,
                "dropped": header.dropped_frames,
                "age": header.available - header.time + time.monotonic() - self._last_frame_time,
            }
            if watch.axis is not None:
                facts["axis"] = {"offset": watch.axis.offset, "tilt": watch.axis.tilt}
        if view is not None:
            facts["crop"] = view.header.crop
        return msgspec.json.encode(facts)
