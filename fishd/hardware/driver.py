"""Protocols of a driver of a force sensor, a servo or a power meter.

docs/how-to/writing-a-driver.md explains how to write one.

A driver knows one kind of hardware and nothing else: calibration, limits, windows, staleness,
suspicion and reconnecting are above it, the same for all.
"""

import math
from abc import ABC, abstractmethod
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from fishd.core.clock import Clock
from fishd.core.foreign_code import contained
from fishd.core.schema import Problem, note, unit
from fishd.hardware.checks import Check, Machine, Result
from fishd.hardware.settings import (
    ForceSensorSettings,
    Gpio,
    PowerMeterSettings,
    ServoSettings,
)

__all__ = [
    "Check",
    "Claim",
    "Clock",
    "ForceSensorDriver",
    "ForceSensorSettings",
    "Gpio",
    "LastResort",
    "Machine",
    "Pair",
    "PowerMeterDriver",
    "PowerMeterSettings",
    "PowerSample",
    "Problem",
    "Result",
    "ServoDriver",
    "ServoSettings",
    "note",
    "pin",
    "unit",
]

S = TypeVar("S", bound=ForceSensorSettings | ServoSettings | PowerMeterSettings)
T = TypeVar("T", bound=ForceSensorSettings | PowerMeterSettings)
F = TypeVar("F", bound=ForceSensorSettings)
P = TypeVar("P", bound=PowerMeterSettings)
V = TypeVar("V", bound=ServoSettings)


class Claim(NamedTuple):
    """Something that at most one fishd may use."""

    name: str
    """The same for the same thing, such as `i2c-1` or `gpio18`."""
    what: str
    """In words, such as `/dev/i2c-1`."""
    key: str
    """The driver's key that names another one."""
    pins: tuple[int, ...] = ()
    """Pins of the header that it takes, Broadcom numbers."""


def pin(gpio: int, what: str, key: str = "gpio") -> Claim:
    """The claim of a pin of the header, such as that of the `servo`."""
    return Claim(f"gpio{gpio}", f"the {what} on GPIO {gpio}", key, (gpio,))


class Driver(ABC, Generic[S]):
    """What all kinds have in common: all of it can be asked without the hardware."""

    Settings: ClassVar[type[Any]]
    """Its keys: a frozen msgspec struct, a subclass of that of its kind."""
    packages: ClassVar[tuple[str, ...]] = ()
    """Of fishd's extras, those that it imports; a package of its own demands what it needs."""
    on_virtual_pi: ClassVar[bool] = False
    """Whether a virtual Pi has what it drives."""

    @classmethod
    def check(cls, settings: S, tick: float) -> None:
        """Refuse settings that are valid one by one but not together, or not with this tick [s].

        Raises `Problem((key,), message)`.
        """

    @classmethod
    def claims(cls, settings: S) -> tuple[Claim, ...]:
        """What no other fishd may use meanwhile, and which pins it takes."""
        return ()

    @classmethod
    def checks(cls, settings: S) -> tuple[Check, ...]:
        """What `fishctl doctor` looks at before it tries the whole; nothing may move or change."""
        return ()

    def counters(self) -> dict[str, int]:
        """Errors that were survived, since start; called from the thread that ticks."""
        return {}


def survived(driver: Driver[Any]) -> dict[str, int]:
    """The counters of a driver; none where it cannot say them, which must not end fishd."""
    try:
        return {str(name): int(count) for name, count in contained(driver.counters).items()}
    except Exception:
        return {}


class Pair(NamedTuple):
    """Two samples that belong together."""

    begun: float
    """When the earlier one began [s, monotonic]."""
    time: float
    """When the later one was complete."""
    vx: float
    """What stands for F_x: a voltage [V], or what `raw_unit` says, in proportion to the force."""
    vy: float
    clipped: str = ""
    """Why the two cannot be believed, as they are at an end of the range; empty where they can."""


class SampledDriver(Driver[T]):
    """Delivers samples. One thread calls `open`, `sample` and `close`."""

    transport: ClassVar[str] = "sensor"
    """What errors are counted as: `i2c` makes `i2c_errors`."""
    settling: float = 0.0
    """How long to leave the hardware alone after an error [s]."""

    def __init__(self, settings: T, clock: Clock) -> None:
        """Import what is needed; open nothing yet. clock: the only one to look at and sleep by."""
        self.settings = settings
        self.clock = clock

    @property
    @abstractmethod
    def place(self) -> str:
        """Which hardware, for messages, such as `the ADS1115 at 0x48 on /dev/i2c-1`."""

    @abstractmethod
    def open(self) -> None:
        """Make ready to sample; raises anything, and is tried again a little later."""

    @abstractmethod
    def sample(self) -> Any:
        """The next sample, a `Pair` or a `PowerSample`, or None where it is not complete yet.

        Takes a few milliseconds at most: it sleeps in `clock.sleep`, and must sleep or transfer
        something before it returns None. Raises anything, which `explain` puts into words; after
        three errors in a row the driver is closed and opened anew.
        """

    @abstractmethod
    def close(self) -> None:
        """Let go of the hardware; raises nothing, may be called twice, and before `open`."""

    def explain(self, error: Exception) -> str:
        """One line about what went wrong, and what to check."""
        return str(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}"


class ForceSensorDriver(SampledDriver[F]):
    """Delivers pairs of samples."""

    raw_unit: ClassVar[str] = "V"
    """Unit of the pairs, in which forces are shown until the sensor is calibrated."""
    names: tuple[str, str] = ("F_x", "F_y")
    """What messages call the two, such as `F_x (channel A0-A1)`."""

    @abstractmethod
    def sample(self) -> Pair | None:
        """The next pair, or None where it is not complete yet; as of every `SampledDriver`."""

    @classmethod
    @abstractmethod
    def pair_rate(cls, settings: F) -> float:
        """Pairs per second that healthy hardware delivers, at the least."""


class PowerSample(NamedTuple):
    """What a power meter says."""

    time: float
    """When it was read [s, monotonic]."""
    power: float
    """Mean electrical power into the servo over the latest time that the meter measured [W]."""
    clipped: str = ""
    """Why it cannot be believed, as it is at an end of the range; empty where it can."""


class PowerMeterDriver(SampledDriver[P]):
    """Delivers the electrical power of the servo, where the robot has a meter for it."""

    def __init__(self, settings: P, clock: Clock, interval: float) -> None:
        """interval: `sample` is called once in this time, and tells the mean over as long [s]"""
        super().__init__(settings, clock)
        self.interval = interval

    @abstractmethod
    def sample(self) -> PowerSample:
        """Read the meter: a few short transfers, as it measures by itself.

        It need not wait: it is not called before its time. Raises anything, as of every
        `SampledDriver`.
        """


class LastResort(NamedTuple):
    """What ends the pulses when the process that made them is dead."""

    function: str
    """`module:function`; called with neutral [µs], then `arguments` by name.

    It sends a servo that gets pulses to neutral for 0.3 s, ends them and returns True; one without
    pulses it leaves alone and returns False. `fishd-release` imports it and has little time: its
    module should need little but the standard library. Raises `ServoError`.
    """
    arguments: dict[str, Any]
    """Whatever JSON can say."""


class ServoDriver(Driver[V]):
    """Sends pulses. `write`, `off` and `close` may be called from any thread."""

    degraded: tuple[str, ...] = ()
    """Why its pulses are not as good as they could be, a line each."""
    countdown: float = math.inf
    """How long the servo goes on without a write [s]; infinite where only this process stops it.

    Then it goes to neutral, and half a second later its pulses end.
    """

    def __init__(
        self, settings: V, neutral: float, clock: Clock, *, tick: float, threaded: bool
    ) -> None:
        """What all have; the rest is in `open`."""
        self.settings = settings
        self.neutral = neutral
        """Pulse of neutral [µs]; another one where the servo is calibrated."""
        self.clock = clock
        """The only one to look at and sleep by."""
        self.tick = tick
        """Period of the writes [s]."""
        self.threaded = threaded
        """Whether time goes on by itself; in virtual time no thread may be started."""
        self.open()

    @abstractmethod
    def open(self) -> None:
        """Open the hardware, or go on without and try again in each write. No pulses begin here.

        Called once. Raises ImportError where a library is missing.
        """

    @abstractmethod
    def write(self, pulse: float) -> None:
        """Send pulses [µs], within 500 to 2500, and begin where there were none.

        In the tick: it must not wait long. Raises `ServoError` when the servo cannot be reached.
        """

    @abstractmethod
    def off(self) -> None:
        """End the pulses, so that the servo holds no torque; may be called twice.

        Raises `ServoError` when the servo cannot be reached.
        """

    @abstractmethod
    def close(self) -> None:
        """End the pulses and let go of the hardware; may be called twice.

        A servo that never got pulses is left as it is. Raises `ServoError` where pulses may still
        be on, once all that could be done is done.
        """

    @classmethod
    def last_resort(cls, settings: V) -> LastResort | None:
        """How another process ends pulses that outlive this one; None where `off` does."""
        return None

    @classmethod
    def read_pulses(cls, settings: V) -> bool | None:
        """Read back, from any process, whether there are pulses; None where that cannot be told.

        Raises `ServoError`.
        """
        return None
