"""What a recording amounts to: how long, who swam, how much thrust, and what is missing."""

from typing import Any, NamedTuple

import msgspec
from msgspec import UNSET, Struct, UnsetType

from fishd.core.decoding import decoder
from fishd.core.signals import Event, Status, Tick
from fishd.recording.images import FrameHead


class Gap(NamedTuple):
    """Ticks that fishd made and that are not in the recording."""

    after: float
    """Time of the last tick before it; without one, of the first tick after it [s, unix]."""
    seq: int
    """Number of the first tick that is missing."""
    lost: int
    """How many are missing."""


class Summary(Struct, frozen=True):
    """A recording in numbers; stands in its last record `fishd.end`."""

    begins: float = 0.0
    """Time of the first tick [s, unix]."""
    ends: float = 0.0
    """Time of the last tick [s, unix]."""
    ticks: int = 0
    events: int = 0
    marks: int = 0
    gaps: int = 0
    """How often ticks are missing."""
    lost: int = 0
    """How many ticks are missing in those gaps."""
    missed: int = 0
    """Slots that fishd itself skipped meanwhile: it made no tick there."""
    restarts: int = 0
    """How often another fishd took the place of the one before."""
    thrust: float | None = None
    """Mean `thrust` over the time in which the tail beat and the sensor's zero was known; where it
    never was, mean F_x while a controller swam, as measured; None where none swam [N]."""
    thrust_error: float | None = None
    """Half of its 95 % interval; None where the zero was never known [N].

    It is the mean of that of the ticks: the errors of one recording are those of one zero, and do
    not average out.
    """
    power: float | None = None
    """Mean electrical power of the servo while a controller swam; None where not known [W]."""
    swimming: dict[str, int] = {}
    """Ticks in mode running, by controller."""
    force_unit: str = "N"
    """Unit of its forces: `N` only where all are in newtons, else that of the others."""
    frames: int = 0
    """Frames of a camera."""
    frame_gaps: int = 0
    """How often frames are missing, or the camera began anew."""
    frames_lost: int = 0
    """How many frames are known to be missing: that the camera took but nobody got, and that did
    not arrive."""

    @property
    def duration(self) -> float:
        """From the first tick to the last [s]."""
        return self.ends - self.begins


class TickHead(Struct, frozen=True, gc=False):
    """As much of a `Tick` as a summary needs."""

    t: float
    seq: int
    mode: str
    controller: str
    fx: float
    missed: int
    thrust: float
    frequency: float
    thrust_error: float | UnsetType = UNSET
    power: float | UnsetType = UNSET
    time: float = 0.0


class Tally:
    """Adds up a recording, tick by tick, while it is written or read."""

    def __init__(self) -> None:
        self.gaps: list[Gap] = []
        self._last: TickHead | Tick | None = None
        self._first_t = 0.0
        self._ticks = self._events = self._marks = self._missed = self._restarts = 0
        self._pid = self._known = 0
        self._impulse = 0.0
        self._known_ticks = 0
        self._thrust = self._error = 0.0
        self._energy, self._metered = 0.0, 0
        self._swimming: dict[str, int] = {}
        self._force_unit = "N"
        self._frames = self._frame_gaps = self._frames_lost = 0
        self._last_frame: FrameHead | None = None

    def measures_in(self, force_unit: str) -> None:
        """Take note of the unit of the forces from now on."""
        if self._force_unit == "N":
            self._force_unit = force_unit

    def add(self, message: TickHead | Tick | Event | Status) -> None:
        """Add any message."""
        if isinstance(message, Event):
            self.event(message)
        elif isinstance(message, Status):
            self.status(message)
        else:
            self.tick(message)

    def tick(self, tick: TickHead | Tick) -> bool:
        """Add a tick; returns False where it is the first of another fishd."""
        last, self._last = self._last, tick
        self._ticks += 1
        if tick.mode == "running":
            self._impulse += tick.fx
            if tick.thrust_error is not UNSET and tick.frequency:
                self._known_ticks += 1
                self._thrust += tick.thrust
                self._error += tick.thrust_error
            if tick.power is not UNSET:
                self._energy += tick.power
                self._metered += 1
            self._swimming[tick.controller] = self._swimming.get(tick.controller, 0) + 1
        if last is None:
            self._first_t = tick.t
            return True
        same = tick.seq > last.seq
        before = last.seq if same else 0  # another fishd counts from 1
        if tick.seq > before + 1:
            self.gaps.append(Gap(last.t, before + 1, tick.seq - before - 1))
        if same:
            self._missed += max(0, tick.missed - last.missed)
        else:
            self._restarts += 1
        return same

    def status(self, status: Status) -> None:
        """Add a status, which also shows another fishd whose ticks have higher numbers."""
        if self._last and status.seq < self._last.seq:  # its next tick will show it
            return
        if self._pid not in (0, status.pid) and self._known == self._restarts:
            self._restarts += 1
        self._pid, self._known = status.pid, self._restarts

    def event(self, event: Event) -> None:
        """Add an event."""
        self._events += 1
        self._marks += event.kind == "mark"

    def frame(self, frame: FrameHead) -> int:
        """Add a frame of a camera; returns how many are missing before it, 0 where none are.

        Of a camera that began anew nobody knows what is missing; that counts as one gap.
        """
        last, self._last_frame = self._last_frame, frame
        self._frames += 1
        if last is None:
            return 0
        if frame.session != last.session:
            self._frame_gaps += 1
            return 0
        lost = max(0, frame.seq - last.seq - 1) + max(0, frame.dropped - last.dropped)
        self._frames_lost += lost
        self._frame_gaps += lost > 0
        return lost

    @property
    def restarts(self) -> int:
        """How often another fishd took the place of the one before."""
        return self._restarts

    @property
    def seconds(self) -> float:
        """From the first tick to the last [s]."""
        return self._last.t - self._first_t if self._last else 0.0

    @property
    def summary(self) -> Summary:
        """All that was added."""
        swam = sum(self._swimming.values())
        thrust = self._impulse / swam if swam else None
        error = None
        if self._known_ticks:
            thrust, error = self._thrust / self._known_ticks, self._error / self._known_ticks
        return Summary(
            begins=self._first_t,
            ends=self._last.t if self._last else 0.0,
            ticks=self._ticks,
            events=self._events,
            marks=self._marks,
            gaps=len(self.gaps),
            lost=sum(gap.lost for gap in self.gaps),
            missed=self._missed,
            restarts=self._restarts,
            thrust=thrust,
            thrust_error=error,
            power=self._energy / self._metered if self._metered else None,
            swimming=dict(self._swimming),
            force_unit=self._force_unit,
            frames=self._frames,
            frame_gaps=self._frame_gaps,
            frames_lost=self._frames_lost,
        )


def to_metadata(summary: Summary) -> dict[str, str]:
    """Its fields as texts, each JSON, as MCAP's metadata wants them."""
    return {
        name: msgspec.json.encode(value).decode()
        for name, value in msgspec.structs.asdict(summary).items()
    }


_decode = decoder(Any)


def from_metadata(data: dict[str, str]) -> Summary | None:
    """The summary in the metadata of a recording; None if it was never written."""
    known = {name: data[name] for name in Summary.__struct_fields__ if name in data}
    try:
        raw = {name: _decode(value.encode()) for name, value in known.items()}
        return msgspec.convert(raw, Summary) if raw else None
    except msgspec.MsgspecError:
        return None
