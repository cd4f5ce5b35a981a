"""Interfaces of a source of frames and of the sink that receives them."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from fishd.camera.messages import Condition
from fishd.core.camera_frames import Pixels
from fishd.core.errors import FishdError


class Shot(NamedTuple):
    """One picture from a source."""

    time: float
    """Middle of the exposure [s, clock of the source]."""
    available: float
    """Time at which the picture became available, on the same clock [s]."""
    picture: Pixels
    """Whole picture, shape (height, width)."""
    exposure: float | None = None
    """Exposure time [s]; None where unknown."""


class Timeline(NamedTuple):
    """Clock of a source's times; each session has one clock."""

    virtual: bool
    boot: str
    """Identifier of the boot of the machine whose monotonic clock it is."""
    now: Callable[[], float] | None
    """Function that reads the clock [s]; None where it is virtual."""


class Trouble(FishdError):
    """A source has no frames at present; the message is one line with the reason."""

    def __init__(self, condition: Condition, problem: str, remedy: str = "") -> None:
        super().__init__(problem)
        self.condition: Condition = condition
        self.remedy = remedy


class Sink(Protocol):
    """Receiver of frames; its methods do not block and may be called in any thread."""

    def begin(self, timeline: Timeline, limitations: tuple[str, ...] = ()) -> None:
        """Start a new session; limitations: reasons why times or pictures are not better."""

    def put(self, shot: Shot) -> None:
        """Publish a frame."""

    def covered(self, until: float) -> None:
        """Declare that all frames available by a time [s] have been put; for a virtual clock."""

    def lost(self, dropped: int = 0, broken: int = 0) -> None:
        """Count frames that were not delivered, and frames that could not be decoded."""

    def trouble(self, trouble: Trouble) -> None:
        """Declare a condition without frames; the next `put` ends it."""

    def alive(self) -> None:
        """Declare that the source does not hang; call it at least once a second."""


class Source(Protocol):
    """Source that puts frames into a sink until it is stopped; runs in a separate thread."""

    device: str
    """Name of the camera for people, without a password."""

    def run(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """Put frames into `sink` until `stopping` returns true.

        stopping: waits for a time [s], and returns true at once when the source must end
        """
