"""Protocols of a driver of a force sensor, a servo or any other sensor.

docs/how-to/writing-a-driver.md explains how to write one.

A driver knows one kind of hardware and nothing else: calibration, limits, windows, staleness,
suspicion and reconnecting are above it, the same for all drivers.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any, ClassVar, Generic, NamedTuple, TypeVar

from fishd.core.clock import Clock
from fishd.core.foreign_code import call_foreign
from fishd.core.schema import Problem, Reading, format_reading, note, unit
from fishd.hardware.checks import Check, Machine, Result, ok
from fishd.hardware.settings import ForceSensorSettings, Gpio, SensorSettings, ServoSettings

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
    "Problem",
    "Reading",
    "Result",
    "SensorDriver",
    "SensorSettings",
    "ServoDriver",
    "ServoSettings",
    "note",
    "pin",
    "unit",
]

S = TypeVar("S", bound=ForceSensorSettings | ServoSettings | SensorSettings)
T = TypeVar("T", bound=ForceSensorSettings | SensorSettings)
F = TypeVar("F", bound=ForceSensorSettings)
R = TypeVar("R", bound=SensorSettings)
V = TypeVar("V", bound=ServoSettings)


class Claim(NamedTuple):
    """Something that at most one fishd may use."""

    name: str
    """Identifier, the same for the same thing, such as `i2c-1` or `gpio18`."""
    what: str
    """Name in messages, such as `/dev/i2c-1`."""
    key: str
    """Key of the driver with which the user chooses another one."""
    pins: tuple[int, ...] = ()
    """Pins of the header that it takes, Broadcom numbers."""


def pin(gpio: int, what: str, key: str = "gpio") -> Claim:
    """Return the claim of a pin of the header, such as that of the `servo`."""
    return Claim(f"gpio{gpio}", f"the {what} on GPIO {gpio}", key, (gpio,))


class Driver(ABC, Generic[S]):
    """Base class of all kinds of drivers; nothing in it needs the hardware."""

    Settings: ClassVar[type[Any]]
    """Class of the driver's keys: a frozen msgspec struct, a subclass of that of its kind."""
    packages: ClassVar[tuple[str, ...]] = ()
    """Packages from fishd's extras that it imports; another package declares its dependencies."""
    on_virtual_pi: ClassVar[bool] = False
    """Whether a virtual Pi has the hardware that it drives."""

    @classmethod
    def check(cls, settings: S, tick: float) -> None:
        """Refuse settings that are valid one by one but not together, or not with this tick [s].

        Raises `Problem((key,), message)`.
        """

    @classmethod
    def claims(cls, settings: S) -> tuple[Claim, ...]:
        """Return what no other fishd may use at the same time, with the pins that it takes."""
        return ()

    @classmethod
    def checks(cls, settings: S) -> tuple[Check, ...]:
        """Return checks that `fishctl doctor` makes before it tries the driver, without motion."""
        return ()

    def counters(self) -> dict[str, int]:
        """Return how many errors it recovered from since start; called in the thread that ticks."""
        return {}


def read_counters(driver: Driver[Any]) -> dict[str, int]:
    """Return the counters of a driver; none if it raises, because that must not end fishd."""
    try:
        return {str(name): int(count) for name, count in call_foreign(driver.counters).items()}
    except Exception:
        return {}


class Pair(NamedTuple):
    """Two samples that belong together."""

    begun: float
    """Time at which the earlier one began [s, monotonic]."""
    time: float
    """Time at which the later one was complete [s, monotonic]."""
    vx: float
    """Value in proportion to F_x: a voltage [V], or in the unit that `raw_unit` names."""
    vy: float
    clipped: str | None = None
    """Reason not to trust the two, such as an end of the range; None if they can be trusted."""


class SampledDriver(Driver[T]):
    """Driver that delivers samples. One thread calls `open`, `sample` and `close`."""

    settling: float = 0.0
    """Time for which the hardware is left alone after an error [s]."""
    limitations: tuple[str, ...] = ()
    """Reasons why its samples are not as good as they could be, a line each."""

    def __init__(self, settings: T, clock: Clock) -> None:
        """Import what is needed; open nothing yet.

        clock: the only clock that the driver may read and sleep by
        """
        self.settings = settings
        self.clock = clock

    @property
    @abstractmethod
    def place(self) -> str:
        """Name of the hardware in messages, such as `the ADS1115 at 0x48 on /dev/i2c-1`."""

    @abstractmethod
    def open(self) -> None:
        """Prepare to sample; may raise any exception, and is tried again a little later."""

    @abstractmethod
    def sample(self) -> Any:
        """Return the next sample, or None if it is not complete yet.

        That of a force sensor is a `Pair` and takes a few milliseconds at most. It sleeps in
        `clock.sleep`, and must sleep or transfer something before it returns None. May raise any
        exception, which `explain` describes; after three errors in a row the driver is closed and
        opened again.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the hardware; raises nothing, may be called twice, and before `open`."""

    def explain(self, error: Exception) -> str:
        """Return one line that says what went wrong and what to check."""
        return str(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}"


class ForceSensorDriver(SampledDriver[F]):
    """Driver of a force sensor, which delivers pairs of samples."""

    transport: ClassVar[str] = "sensor"
    """Prefix of the counters of errors: `i2c` makes `i2c_errors`."""
    raw_unit: ClassVar[str] = "V"
    """Unit of the pairs, in which forces are shown until the sensor is calibrated."""
    names: tuple[str, str] = ("F_x", "F_y")
    """Names of the two channels in messages, such as `F_x (channel A0-A1)`."""

    @abstractmethod
    def sample(self) -> Pair | None:
        """Return the next pair, or None if it is not complete yet; see `SampledDriver.sample`."""

    @classmethod
    @abstractmethod
    def pair_rate(cls, settings: F) -> float:
        """Return the lowest rate at which healthy hardware delivers pairs [1/s]."""


class SensorDriver(SampledDriver[R]):
    """Driver of any other sensor: it declares its readings, and `sample` returns their values."""

    readings: ClassVar[Mapping[str, Reading]] = {}
    """Readings by name, such as `{"water_temperature": Reading("°C", "Temperature of the water")}`.
    A value beyond `low` or `high` is doubtful, but shown."""
    samples_per_tick: ClassVar[int] = 1
    """Number of samples in a tick where the configuration sets no period."""
    is_simulated: ClassVar[bool] = False
    """Whether it needs no hardware and never waits: a simulated fish has such a sensor, too."""

    def __init__(self, settings: R, clock: Clock, period: float, section: str) -> None:
        """Import what is needed; open nothing yet.

        clock: the only clock that the driver may read and sleep by
        period: time between two calls of `sample` [s]
        section: section of its keys in the configuration, such as `sensors.water`, for messages
        """
        super().__init__(settings, clock)
        self.period = period
        self.section = section

    @classmethod
    def declare(cls, settings: R) -> Mapping[str, Reading]:
        """Return the readings by name, which may depend on the settings."""
        return cls.readings

    @property
    def place(self) -> str:
        """Name of the sensor in messages."""
        return self.section

    def open(self) -> None:
        """Prepare to sample, if that is necessary; see `SampledDriver.open`."""

    @abstractmethod
    def sample(self) -> Mapping[str, float] | None:
        """Return the values of the readings by name, or None if there are none yet.

        One that is missing or NaN keeps its latest value, and grows old. It runs in a thread of its
        own, so it may wait. May raise any exception; see `SampledDriver.sample`.
        """

    def close(self) -> None:
        """Release the hardware, if `open` took any; see `SampledDriver.close`."""

    def judge(self, values: Mapping[str, float]) -> Result:
        """Return the result of the check of `fishctl doctor` for a sample, just after it."""
        units = {name: reading.unit for name, reading in self.declare(self.settings).items()}
        return ok(", ".join(f"{n} {format_reading(v, units[n])}" for n, v in values.items()))


class LastResort(NamedTuple):
    """Function that ends the pulses after the process that made them has died."""

    function: str
    """Name as `module:function`; called with neutral [µs], then `arguments` by name.

    It sends a servo that gets pulses to neutral for 0.3 s, ends them and returns True. It leaves a
    servo without pulses alone and returns False. `fishd-release` imports it and has little time:
    its module should import little beyond the standard library. Raises `ServoError`.
    """
    arguments: dict[str, Any]
    """Arguments of the function, all of which JSON can represent."""


class ServoDriver(Driver[V]):
    """Driver that sends pulses. `write`, `off` and `close` may be called from any thread."""

    limitations: tuple[str, ...] = ()
    """Reasons why its pulses are not as good as they could be, a line each."""
    countdown: float = math.inf
    """Time for which the servo continues without a write [s]; infinite without such a limit.

    After that time it goes to neutral, and half a second later its pulses end.
    """

    def __init__(
        self, settings: V, neutral: float, clock: Clock, *, tick: float, threaded: bool
    ) -> None:
        """Store what all drivers need, and call `open`."""
        self.settings = settings
        self.neutral = neutral
        """Pulse width of neutral [µs]; it changes when the servo is calibrated."""
        self.clock = clock
        """The only clock that the driver may read and sleep by."""
        self.tick = tick
        """Period of the writes [s]."""
        self.threaded = threaded
        """Whether time passes by itself; in virtual time no thread may be started."""
        self.open()

    @abstractmethod
    def open(self) -> None:
        """Open the hardware, or continue without it and try again in each write; start no pulses.

        Called once. Raises ImportError if a library is missing.
        """

    @abstractmethod
    def write(self, pulse: float) -> None:
        """Send pulses of a width [µs] within 500 to 2500; start them if there are none.

        Called in the tick: it must not wait long. Raises `ServoError` when the servo cannot be
        reached.
        """

    @abstractmethod
    def off(self) -> None:
        """End the pulses, so that the servo holds no torque; may be called twice.

        Raises `ServoError` when the servo cannot be reached.
        """

    @abstractmethod
    def close(self) -> None:
        """End the pulses and release the hardware; may be called twice.

        A servo that never got pulses is not changed. Raises `ServoError` if pulses may still be
        on after every attempt to end them.
        """

    @classmethod
    def last_resort(cls, settings: V) -> LastResort | None:
        """Return how another process ends pulses that outlive this one; None if `off` suffices."""
        return None

    @classmethod
    def read_pulses(cls, settings: V) -> bool | None:
        """Read back, from any process, whether there are pulses; return None if this is unknown.

        Raises `ServoError`.
        """
        return None
