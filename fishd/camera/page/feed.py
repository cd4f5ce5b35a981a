"""Follows a camera in a thread of its own, and keeps the newest picture for the page."""

import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec

from fishd.camera.axis_watch import AxisWatch
from fishd.camera.client import CameraClient
from fishd.core.errors import FishError

TOLD = 0.5
"""Without a picture, the state is told so often [s]."""


class News(NamedTuple):
    """What the page is to show from now on."""

    facts: bytes
    """State, rate, age, losses and axis, as one JSON object."""
    jpeg: bytes | None
    """The picture; None if it is not new."""


class Feed:
    """The camera as the page shows it; `run` is for a thread of its own."""

    def __init__(self, address: str | None, tell: Callable[[News], None]) -> None:
        """
        address: where the camera takes requests; None as `CameraClient` finds it
        tell: gets each news, in the thread of `run`

        Raises `CameraLost` where there is no camera at the start.
        """
        self._client = CameraClient(address, views=True)
        self._watch = AxisWatch()
        self._tell = tell
        self._heard = self._told = time.monotonic()
        self._stopping = threading.Event()
        self._lost = ""

    def run(self) -> None:
        """Follow the camera, through any restart of it, until told to stop."""
        try:
            shown = None
            while not self._stopping.is_set():
                frames = self._client.poll(0.1)
                now = time.monotonic()
                for frame in frames:
                    self._watch.add(frame)
                    self._heard, self._lost = now, ""
                if self._watch.due:
                    self._watch.find()
                view = self._client.view
                if view is not None and view is not shown:
                    shown, self._told = view, now
                    self._tell(News(self._facts(), view.jpeg))
                elif now - self._told > TOLD:
                    self._told = now
                    self._check()
                    self._tell(News(self._facts(), None))
        finally:
            self.close()

    def stop(self) -> None:
        """End `run` soon."""
        self._stopping.set()

    def close(self) -> None:
        """Leave the camera, where `run` has not begun; it does so itself at its end."""
        self._client.close()

    def _check(self) -> None:
        try:
            self._client.check()
        except FishError as error:
            self._lost = str(error)
            # Each question waits for an answer; no more than one a second is asked.
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
                "dropped": header.dropped,
                "age": header.available - header.time + time.monotonic() - self._heard,
            }
            if watch.axis is not None:
                facts["axis"] = {"offset": watch.axis.offset, "tilt": watch.axis.tilt}
        if view is not None:
            facts["crop"] = view.header.crop
        return msgspec.json.encode(facts)
