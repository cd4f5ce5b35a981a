"""The camera of a fish in the page: its pictures, the measured tail, and the axis of motion.

A thread follows a camera while a page looks at it. fishd-camera makes each JPEG once, for all
pages; here none is decoded, and the page draws tail and axis into it.
"""

import asyncio
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

from msgspec import Struct

from fishd.core import text
from fishd.core.decoding import decoder
from fishd.core.errors import FishError
from fishd.window.fish_link import FishLink
from fishd.window.live import encode, encode_message
from fishd.window.viewer import Viewer

if TYPE_CHECKING:  # they load numpy, which the window needs for a camera only
    from fishd.camera.axis import AxisWatch
    from fishd.camera.client import CameraClient
    from fishd.camera.messages import PublishedView, TailMessage
    from fishd.camera.tail_watch import TailWatch

log = logging.getLogger(__name__)

FACTS_PERIOD_S = 0.5
"""Time between two messages about the camera [s]."""
MIDLINE_TIMEOUT_S = 0.15
"""Longest wait of a picture for its midline [s]."""
RETRY_S = 1.0
"""Time until a camera that does not answer is tried again [s]."""
MAX_READINGS = 64
"""Number of latest fin angles among which that of a picture is searched."""
MAX_COMMANDS = 1024
"""Number of instruction angles that wait for the thread of a camera."""
MAX_PICTURE_BYTES = 2**20
"""Largest picture that is sent to pages [bytes]."""


Picture = tuple[str, bytes]
"""Crop, midline and fin angle, which the page draws, as JSON; and the JPEG picture itself."""


class CameraViewer(Viewer):
    """An open page that shows a camera. It gets a picture only after it has drawn the last one."""

    kind = "camera picture"

    def __init__(self, device_id: str) -> None:
        super().__init__()
        self.device_id, self.aligns = device_id, False
        """`aligns`: whether it shows the axis of motion."""
        self._facts: str | None = None
        self._picture: Picture | None = None
        self._has_drawn = True

    def show(self, message: str | Picture) -> None:
        """Send facts, or a picture, next; it replaces one that still waits."""
        if isinstance(message, str):
            self._facts = message
        else:
            self._picture = message
        self.wake()

    def take(self) -> Iterable[str | bytes]:
        """Return the messages that wait and that the page can take."""
        messages: list[str | bytes] = [self._facts] if self._facts else []
        self._facts = None
        if self._picture and self._has_drawn:
            messages += self._picture
            self._picture, self._has_drawn = None, False
        return messages

    def receive(self, message: str) -> None:
        """Note that the page has drawn a picture, or whether it shows the axis."""
        if message == '["drawn"]':
            self._has_drawn = True
            self.wake()
        elif message.startswith('["align",'):
            self.aligns = message == '["align",true]'


class CameraFeed:
    """Pictures of a camera for pages; use it in one event loop."""

    def __init__(self, address: str | None, link: FishLink) -> None:
        """
        address: address of the camera's requests; None: as for `CameraClient`
        link: link to the fish below the camera
        """
        self._address, self._link = address, link
        self._viewers: set[CameraViewer] = set()
        self._commands: deque[tuple[float, float]] = deque(maxlen=MAX_COMMANDS)
        """Times [s, clock of fishd] and instruction angles [rad] for the thread."""
        self._is_followed = False

    @contextmanager
    def open(self, device_id: str) -> Iterator[CameraViewer]:
        """Yield a new viewer, which gets pictures within the context."""
        viewer = CameraViewer(device_id)
        self._viewers.add(viewer)
        self._link.listeners.add(self._hear)
        self._start()
        try:
            yield viewer
        finally:
            self._viewers.discard(viewer)
            if not self._viewers:
                self._link.listeners.discard(self._hear)

    def _hear(self, topic: str, _t: float, payload: bytes) -> None:
        """Keep the instruction angle of a tick."""
        if topic == "tick":
            command = _decode_command(payload)
            self._commands.append((command.time, command.phi_c))

    def _start(self) -> None:
        if not self._is_followed and self._viewers:
            self._is_followed = True
            loop = asyncio.get_running_loop()
            threading.Thread(target=self._follow_on, args=(loop,), daemon=True).start()

    def _ended(self) -> None:
        self._is_followed = False
        self._start()

    def _show(self, message: str | Picture) -> None:
        for viewer in self._viewers:
            viewer.show(message)

    # The rest runs in the thread.

    def _follow_on(self, loop: asyncio.AbstractEventLoop) -> None:
        def tell(message: str | Picture) -> None:
            loop.call_soon_threadsafe(self._show, message)

        with suppress(RuntimeError):  # the window has ended
            while self._viewers:
                try:
                    self._follow(tell)
                except Exception as error:
                    if not isinstance(error, FishError):
                        log.exception("the camera of %s cannot be followed", self._link.name)
                    tell(_encode_facts(text.describe_error(error), is_lost=True))
                    time.sleep(RETRY_S)
            loop.call_soon_threadsafe(self._ended)

    def _follow(self, tell: Callable[[str | Picture], None]) -> None:
        """Give pictures and facts to `tell` while a page looks; raise `FishError` if none come."""
        from fishd.camera.axis import AxisWatch
        from fishd.camera.client import CameraClient
        from fishd.camera.tail_watch import TailWatch

        axis, tail, view, is_shown = AxisWatch(), TailWatch(), None, True
        next_facts = deadline = 0.0
        readings: deque[TailMessage] = deque(maxlen=MAX_READINGS)
        with CameraClient(self._address, views=True, tail=True) as client:
            while viewers := tuple(self._viewers):
                frames = client.poll(0.1)
                if any(viewer.aligns for viewer in viewers):
                    for frame in frames:
                        axis.add(frame)
                    if axis.due:
                        axis.find()
                self._pass_commands(client.state.boot_id, tail)
                for reading in client.take_tails():
                    tail.add(reading)
                    readings.append(reading)
                now = time.monotonic()
                if client.view is not view:
                    view, is_shown = client.view, False
                    is_measured = client.state.tail == "measuring"
                    deadline = now + MIDLINE_TIMEOUT_S * is_measured
                if view and not is_shown:
                    same = next((r for r in readings if r.seq == view.header.seq), None)
                    if (is_shown := bool(same) or now >= deadline) and _is_small(view):
                        tell(_make_picture(client, view, same))
                if now >= next_facts:
                    next_facts = now + FACTS_PERIOD_S
                    client.check()
                    tell(_describe(client, axis, tail))

    def _pass_commands(self, boot_id: str, tail: "TailWatch") -> None:
        """Add the instruction angles to `tail`, if the camera has the clock of fishd."""
        while self._commands:
            command = self._commands.popleft()
            if self._link.status and self._link.status.boot_id == boot_id:
                tail.add_command(*command)


class _Command(Struct):
    time: float
    phi_c: float


_decode_command: Callable[[bytes], _Command] = decoder(_Command)


def _is_small(view: "PublishedView") -> bool:
    return len(view.jpeg) <= MAX_PICTURE_BYTES


def _make_picture(
    client: "CameraClient", view: "PublishedView", tail: "TailMessage | None"
) -> Picture:
    """Return a picture; tail: fin angle in it, if that is known."""
    state, crop = client.state, view.header.crop
    header = {
        "crop": (crop.left, crop.top, crop.width, crop.height),
        "size": (state.picture_width, state.picture_height),
        "midline": tail.midline if tail else (),
        "alpha": tail and tail.alpha,
        "uncertainty": tail and tail.uncertainty,
        "reason": tail.reason if tail else "",
    }
    return encode_message("picture", encode(header)).decode(), view.jpeg


def _describe(client: "CameraClient", axis: "AxisWatch", tail: "TailWatch") -> str:
    """Return facts about a camera and its latest pictures."""
    state, lines = client.state, list[str]()
    if state.state == "streaming":
        age = f", {state.latency * 1e3:.0f} ms old when they come" if state.latency else ""
        lines.append(f"{state.rate:.1f} pictures a second{age}")
    lost = {
        "not delivered": state.dropped_frames,
        "broken": state.broken_frames,
        "lost on the way": client.missed,
        "not measured for lack of time": state.unmeasured_pictures,
    }
    if any(lost.values()):
        lines.append(", ".join(f"{count} {what}" for what, count in lost.items() if count))
    if client.view is None:
        lines.append("it sends no pictures for people: publish.view_rate of its settings is 0")
    elif not _is_small(client.view):
        lines.append("its pictures are too large for the page: reduce publish.view_width")
    if tail.latest:
        lines.append(tail.describe())
    elif state.tail != "measuring":
        unlearned = "not learned: run fishctl camera measure --learn"
        reason = state.tail_problem or {"unlearned": unlearned}.get(state.tail, state.tail)
        lines.append(f"fin angle: {reason}")
    return _encode_facts(
        f"{state.state}: {state.device}",
        [line for line in (state.problem, state.remedy, *lines, *state.limitations) if line],
        axis=axis.axis and (axis.axis.offset, axis.axis.tilt, state.width),
    )


def _encode_facts(title: str, lines: Sequence[str] = (), **more: object) -> str:
    """Return facts about a camera for a page."""
    return encode_message("facts", encode({"title": title, "lines": lines, **more})).decode()
