"""Summary of a recording: duration, controllers, thrust, and missing data."""

from collections.abc import Mapping
from typing import Any, NamedTuple, TypeAlias

import msgspec
from msgspec import UNSET, Struct, UnsetType

from fishd.core.camera_frames import FrameHead
from fishd.core.decoding import decoder
from fishd.core.robots import find_kind
from fishd.core.signals import Event, Status, Tick
from fishd.core.tail_reading import RecordedTail
from fishd.recording.axis import Axis, ClockStep, ClockSteps


class Gap(NamedTuple):
    """Gap: consecutive ticks of fishd that are missing in the recording."""

    after: float
    """Time of the last tick before the gap, since the first tick of the recording [s]."""
    seq: int
    """Number of the first missing tick."""
    lost: int
    """Number of missing ticks."""


class Summary(Struct):
    """Summary of a recording; part of its last record `fishd.end`."""

    begins: float = 0.0
    """Time of the first tick [s, unix]."""
    ends: float = 0.0
    """Time of the last tick [s, unix]."""
    duration: float = 0.0
    """Time from the first tick to the last on the monotonic clock [s]."""
    ticks: int = 0
    events: int = 0
    marks: int = 0
    gaps: int = 0
    """Number of gaps."""
    lost_ticks: int = 0
    """Number of missing ticks in all gaps."""
    missed_slots: int = 0
    """Number of slots that fishd itself skipped, without a tick."""
    restarts: int = 0
    """Number of times that another fishd took over."""
    thrust: float | None = None
    """Mean `thrust` while the tail beat and the sensor's zero was known; if it never was, mean
    measured F_x while a controller swam; None if none swam [N]."""
    thrust_ci95: float | None = None
    """Half-width of the 95 % confidence interval of `thrust`; None if the zero was never known [N].

    It is the mean of those of the ticks: all ticks share the error of one zero, which does not
    average out.
    """
    readings: dict[str, float] = {}
    """Means of the readings of the sensors while a controller swam, by name."""
    swim_ticks: dict[str, int] = {}
    """Number of ticks in mode running, by controller."""
    force_unit: str = "N"
    """Unit of the forces: `N` if all are in newtons, else the other unit."""
    frames: int = 0
    """Number of frames of a camera."""
    frame_gaps: int = 0
    """Number of places with missing frames, or with a restart of the camera."""
    lost_frames: int = 0
    """Known number of missing frames: not delivered by the camera, or lost on the way."""
    tails: int = 0
    """Number of fin angles that a camera has measured."""
    clock_steps: tuple[ClockStep, ...] = ()
    """Steps of the unix clock of fishd's machine."""


class TickHead(Struct, frozen=True, gc=False):
    """The fields of a `Tick` that a summary needs."""

    t: float
    seq: int
    mode: str
    controller: str
    fx: float
    missed_slots: int
    thrust: float
    frequency: float
    thrust_ci95: float | UnsetType = UNSET
    readings: dict[str, float] | UnsetType = UNSET
    time: float = 0.0
    busy_time_us: float = 0.0


Message: TypeAlias = TickHead | Tick | Event | Status | FrameHead | RecordedTail


def times_of(message: Message) -> tuple[float, float]:
    """Return the time of a message on the unix clock, and on fishd's monotonic clock [s]."""
    return message.t, message.clock if isinstance(message, Status) else message.time


def place(axis: Axis, message: Message, arrival: float | None = None) -> float:
    """Return the time of a message as `Axis.place` does."""
    seq = message.seq if isinstance(message, TickHead | Tick) else None
    return axis.place(*times_of(message), seq, arrival)


class Tally:
    """Running summary of a recording while it is written or read."""

    def __init__(self) -> None:
        self.gaps: list[Gap] = []
        self._last: TickHead | Tick | None = None
        self._sent = 0
        """Number of the latest tick that the present fishd is known to have published; 0 if no."""
        self._counts = Summary(swim_ticks={})
        """Counts until now; `summary` adds what is computed."""
        self._first = self._position = 0.0
        self._clock_steps = ClockSteps()
        self._is_real_time = True
        self._pid = self._known = 0
        self._impulse = 0.0
        self._known_ticks = 0
        self._thrust = self._error = 0.0
        self._readings: dict[str, tuple[float, int]] = {}
        """Sum and number of the values of each reading."""
        self._last_frame: FrameHead | None = None

    def set_daemon(self, daemon: Mapping[str, str]) -> None:
        """Set the metadata of the fishd of the following ticks."""
        if self._counts.force_unit == "N":
            self._counts.force_unit = daemon.get("force_unit", "N")
        self._is_real_time = find_kind(daemon.get("robot", "")).is_real_time

    def add(self, message: TickHead | Tick | Event | Status, position: float) -> None:
        """Add a message of any kind; position: its time on the axis of the recording [s]."""
        if isinstance(message, Event):
            self.event(message)
        elif isinstance(message, Status):
            self.status(message)
        else:
            self.tick(message, position)

    def tick(self, tick: TickHead | Tick, position: float) -> bool:
        """Add a tick; return False if it is the first of another fishd.

        position: its time on the axis of the recording [s]
        """
        last, self._last = self._last, tick
        before_gap, self._position = self._position - self._first, position
        if self._is_real_time:
            self._clock_steps.add(
                position - (self._first if last else position),
                tick.t,
                tick.time + 1e-6 * tick.busy_time_us,
            )
        counts = self._counts
        counts.ticks += 1
        if tick.mode == "running":
            self._impulse += tick.fx
            if tick.thrust_ci95 is not UNSET and tick.frequency:
                self._known_ticks += 1
                self._thrust += tick.thrust
                self._error += tick.thrust_ci95
            for name, value in (tick.readings or {}).items():
                total, count = self._readings.get(name, (0.0, 0))
                self._readings[name] = total + value, count + 1
            counts.swim_ticks[tick.controller] = counts.swim_ticks.get(tick.controller, 0) + 1
        is_same_fishd = last is None or tick.seq > last.seq
        if not is_same_fishd:  # it counts from 1
            self._sent = 0
        if self._sent or last:
            self._expect(tick.seq - 1, before_gap)
        self._sent = max(self._sent, tick.seq)
        if last is None:
            counts.begins, self._first = tick.t, position
            return True
        if is_same_fishd:
            counts.missed_slots += max(0, tick.missed_slots - last.missed_slots)
        else:
            counts.restarts += 1
        return is_same_fishd

    def status(self, status: Status) -> None:
        """Add a status, which reveals lost ticks, and another fishd with higher tick numbers."""
        if self._last and status.seq < self._last.seq:  # its next tick will reveal it
            return
        if self._pid not in (0, status.pid) and self._known == self.restarts:
            self._counts.restarts += 1
        elif self._sent:
            self._expect(status.seq, self.seconds)
        self._sent = max(self._sent, status.seq)
        self._pid, self._known = status.pid, self.restarts

    def expect(self, seq: int) -> None:
        """Count the ticks that follow this number as lost if they are not added."""
        self._sent = seq

    def _expect(self, seq: int, after: float) -> None:
        """Add a gap if ticks up to this number, which the present fishd has sent, are missing."""
        if seq > self._sent:
            self.gaps.append(Gap(after, self._sent + 1, seq - self._sent))

    def event(self, event: Event) -> None:
        """Add an event."""
        self._counts.events += 1
        self._counts.marks += event.kind == "mark"

    def frame(self, frame: FrameHead) -> int:
        """Add a frame of a camera; return the number of frames that are missing before it.

        After a restart of the camera that number is unknown; the restart counts as one gap.
        """
        last, self._last_frame = self._last_frame, frame
        self._counts.frames += 1
        if last is None:
            return 0
        if frame.session != last.session:
            self._counts.frame_gaps += 1
            return 0
        lost = max(0, frame.seq - last.seq - 1) + max(0, frame.dropped_frames - last.dropped_frames)
        self.lose_frames(lost)
        return lost

    def tail(self) -> None:
        """Add a fin angle."""
        self._counts.tails += 1

    def lose_frames(self, count: int) -> None:
        """Count frames that were published after the latest one that was added."""
        self._counts.lost_frames += count
        self._counts.frame_gaps += count > 0

    @property
    def seq(self) -> int:
        """Number of the latest tick; 0 before the first."""
        return self._last.seq if self._last else 0

    @property
    def restarts(self) -> int:
        """Number of times that another fishd took over."""
        return self._counts.restarts

    @property
    def seconds(self) -> float:
        """Time from the first tick to the last [s]."""
        return self._position - self._first

    @property
    def clock_steps(self) -> list[ClockStep]:
        """Steps of the unix clock until now."""
        return self._clock_steps.steps

    @property
    def summary(self) -> Summary:
        """Summary of everything added until now."""
        swim_ticks = dict(self._counts.swim_ticks)
        thrust = self._impulse / sum(swim_ticks.values()) if swim_ticks else None
        error = None
        if self._known_ticks:
            thrust, error = self._thrust / self._known_ticks, self._error / self._known_ticks
        return msgspec.structs.replace(
            self._counts,
            ends=self._last.t if self._last else 0.0,
            duration=self.seconds,
            gaps=len(self.gaps),
            lost_ticks=sum(gap.lost for gap in self.gaps),
            thrust=thrust,
            thrust_ci95=error,
            readings={name: total / count for name, (total, count) in self._readings.items()},
            swim_ticks=swim_ticks,
            clock_steps=tuple(self.clock_steps),
        )


def to_metadata(summary: Summary) -> dict[str, str]:
    """Return the fields as JSON texts, for MCAP's metadata."""
    return {
        name: msgspec.json.encode(value).decode()
        for name, value in msgspec.structs.asdict(summary).items()
    }


_decode = decoder(Any)


def from_metadata(data: dict[str, str]) -> Summary | None:
    """Return the summary in the metadata of a recording; None if it has none."""
    known = {name: data[name] for name in Summary.__struct_fields__ if name in data}
    try:
        raw = {name: _decode(value.encode()) for name, value in known.items()}
        return msgspec.convert(raw, Summary) if raw else None
    except msgspec.MsgspecError:
        return None
