"""What a source of frames is, and where it puts them."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

from fishd.camera.messages import Condition
from fishd.core.camera_frames import Pixels
from fishd.core.errors import FishdError


class Shot(NamedTuple):
    """One picture as a source has it."""

    time: float
    """Middle of its exposure [s, clock of the source]."""
    available: float
    """When it could first be had, on the same clock [s]."""
    picture: Pixels
    """The whole of it, shape (height, width)."""
    exposure: float | None = None
    """Its length [s]; None where it is not known."""


class Timeline(NamedTuple):
    """The clock on which a source tells its times; another one is another session."""

    virtual: bool
    boot: str
    """Names the start of the machine whose monotonic clock it is."""
    now: Callable[[], float] | None
    """[s]; None where it is virtual."""


class Trouble(FishdError):
    """A source has no frames just now; the message is one line that says why."""

    def __init__(self, condition: Condition, problem: str, remedy: str = "") -> None:
        super().__init__(problem)
        self.condition: Condition = condition
        self.remedy = remedy


class Sink(Protocol):
    """Takes what a source has; its methods wait for nobody and may be called in any thread."""

    def begin(self, timeline: Timeline, degraded: tuple[str, ...] = ()) -> None:
        """Frames follow, in a new session; what keeps them from being as good as could be."""

    def put(self, shot: Shot) -> None:
        """Publish a frame."""

    def covered(self, until: float) -> None:
        """All frames that were to be had by then [s] have been put; for a virtual clock."""

    def lost(self, dropped: int = 0, broken: int = 0) -> None:
        """Count frames that nobody got, and such as could not be decoded."""

    def trouble(self, trouble: Trouble) -> None:
        """There are no frames just now, and why; `put` says that it is over."""

    def alive(self) -> None:
        """The source does not hang; to be called once a second at least."""


class Source(Protocol):
    """Puts frames into a sink until it is told to stop; runs in a thread of its own."""

    device: str
    """What it opens, for people; never a password."""

    def run(self, sink: Sink, stopping: Callable[[float], bool]) -> None:
        """stopping: waits for so long [s], and is true as soon as the source is to end."""
