"""Emulated pigpiod and servos on it, for tests of the pigpio servo."""

import contextlib
import inspect
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import pigpio
import pytest

from fishd.core.calibration import ServoCalibration
from fishd.core.clock import SystemClock, VirtualClock
from fishd.core.errors import ServoError
from fishd.hardware.servo import pigpio_client, pigpio_link, pigpio_pulses
from fishd.hardware.servo.calibrated_servo import CalibratedServo
from fishd.hardware.servo.pigpio import Pigpio, PigpioSettings
from fishd.hardware.servo.pigpio_client import MAX_SCRIPTS, Client, open_client
from fishd.hardware.servo.pigpio_link import VIRTUAL_TIMEOUT_S, PigpioLink
from fishd.hardware.servo.pigpio_pulses import neutralise
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.pigpiod.daemon import Pigpiod

GPIO = 18
FRAME = 0.02
TICK = 0.05


class Bench:
    """Emulated pigpiod and its servos, in virtual or real time by its clock."""

    def __init__(
        self, stack: contextlib.ExitStack, clock: VirtualClock | SystemClock | None = None
    ) -> None:
        self.clock: Any = clock or VirtualClock()
        self.faults = Faults(self.clock)
        self.daemon = Pigpiod(self.clock, self.faults)
        self.daemon.start()
        stack.callback(self.daemon.close)
        self._stack = stack

    def settings(self) -> PigpioSettings:
        return PigpioSettings(gpio=GPIO, port=self.daemon.port)

    def servo(
        self,
        settings: PigpioSettings | None = None,
        calibration: ServoCalibration | None = None,
        tick: float = TICK,
    ) -> CalibratedServo:
        realtime = isinstance(self.clock, SystemClock)
        servo = CalibratedServo(
            Pigpio if realtime else partial(Pigpio, standstill=self.daemon.stands_still),
            settings or self.settings(),
            calibration or ServoCalibration(),
            self.clock,
            threaded=realtime,
            tick=tick,
        )
        self._stack.callback(self._close, servo)
        return servo

    def link(self, prepare: Callable[[Client], None]) -> PigpioLink:
        settings = self.settings()
        address = settings.host, settings.port
        return PigpioLink(address, settings.timeout, SystemClock(), prepare, threaded=True)

    def last_resort(self, neutral: float = 1500.0) -> bool:
        """Run the last resort, as another process does when fishd is dead."""
        place = {"gpio": GPIO, "host": "127.0.0.1", "port": self.daemon.port}
        return neutralise(neutral, **place, sleep=self.clock.sleep)  # type: ignore[arg-type]

    @staticmethod
    def _close(servo: CalibratedServo) -> None:
        with contextlib.suppress(ServoError):
            servo.close()

    @property
    def width(self) -> float:
        """Return the pulse after one frame [µs]."""
        return self.daemon.width(GPIO, self.clock.monotonic() + FRAME)

    def wait(self, seconds: float) -> None:
        self.clock.sleep(seconds)

    def client(self) -> contextlib.AbstractContextManager[Client]:
        return open_client("127.0.0.1", self.daemon.port)

    def scripts(self) -> int:
        """Return the number of scripts that pigpiod stores."""
        running = 0
        with self.client() as client:
            for script in range(MAX_SCRIPTS):
                client.within(VIRTUAL_TIMEOUT_S)
                running += bool(client.script_status(script)[1])
        return running

    def refuse(self, command: int, value: int) -> None:
        """Make pigpiod refuse this command with this second parameter."""
        commands = self.daemon._commands
        execute = commands.execute

        def refusing(
            time: float, number: int, p1: int, p2: int, extension: bytes
        ) -> tuple[int, bytes]:
            if (number, p2) == (command, value):
                return pigpio.PI_NOT_PERMITTED, b""
            return execute(time, number, p1, p2, extension)

        commands.execute = refusing

    def hang_up(self) -> None:
        """Close all connections of pigpiod; pulses continue."""
        for connection in list(self.daemon._connections.values()):
            connection.hang_up()

    def hang_up_in_next_sleep(self) -> None:
        """Close all connections during the next sleep of fishd."""
        sleep = self.clock.sleep

        def hang_up(seconds: float) -> None:
            if self.clock.sleep is not sleep:  # callers with the old function call it again
                self.clock.sleep = sleep
                self.hang_up()
            sleep(seconds)

        self.clock.sleep = hang_up

    def changes_after(self, time: float) -> list[tuple[float, float]]:
        return [(when, width) for when, width in self.daemon.history(GPIO) if when > time]


def connect(servo: CalibratedServo) -> None:
    """Return a connected servo without a write or release."""
    with link_of(servo).session():
        pass


def link_of(servo: CalibratedServo) -> PigpioLink:
    """Return the servo's link to pigpiod."""
    assert isinstance(servo.driver, Pigpio)
    return servo.driver._link


def script_of(servo: CalibratedServo) -> int:
    """Return the number of the servo's countdown script."""
    assert isinstance(servo.driver, Pigpio)
    return servo.driver._script


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """Yield a bench in virtual time, whose clients have patience with a busy machine."""
    for module in (pigpio_client, pigpio_link, pigpio_pulses):
        monkeypatch.setattr(module, "ANSWER_TIMEOUT_S", VIRTUAL_TIMEOUT_S)
    monkeypatch.setattr(inspect.unwrap(open_client), "__defaults__", (VIRTUAL_TIMEOUT_S,))
    with contextlib.ExitStack() as stack:
        yield Bench(stack)
