"""What tests of the pigpio servo are built from: an emulated pigpiod in virtual time."""

import contextlib

from fishd.clock import VirtualClock
from fishd.emulation.faults import Faults
from fishd.emulation.pigpiod import errors
from fishd.emulation.pigpiod.daemon import Pigpiod
from fishd.errors import ServoError
from fishd.hardware.calibration import ServoCalibration
from fishd.hardware.pigpio import PigpioServo
from fishd.hardware.pigpio_client import Client, opened
from fishd.hardware.settings import PigpioSettings, ServoSettings

GPIO = 18
FRAME = 0.02
TICK = 0.05


class PigpioBench:
    """An emulated pigpiod, and servos on it."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        self.clock = VirtualClock()
        self.faults = Faults(self.clock)
        self.daemon = Pigpiod(self.clock, self.faults)
        self.daemon.start()
        stack.callback(self.daemon.close)
        self._stack = stack

    def settings(self) -> ServoSettings:
        return ServoSettings(gpio=GPIO, pigpio=PigpioSettings(port=self.daemon.port))

    def servo(
        self,
        settings: ServoSettings | None = None,
        calibration: ServoCalibration | None = None,
        tick: float = TICK,
    ) -> PigpioServo:
        servo = PigpioServo(
            settings or self.settings(),
            calibration or ServoCalibration(),
            self.clock,
            threaded=False,
            tick=tick,
        )
        self._stack.callback(self._close, servo)
        return servo

    @staticmethod
    def _close(servo: PigpioServo) -> None:
        with contextlib.suppress(ServoError):
            servo.close()

    @property
    def width(self) -> float:
        """The pulse in force one frame from now [µs]."""
        return self.daemon.width(GPIO, self.clock.now + FRAME)

    def wait(self, seconds: float) -> None:
        self.clock.sleep(seconds)

    def client(self) -> contextlib.AbstractContextManager[Client]:
        return opened(PigpioSettings(port=self.daemon.port))

    def scripts(self) -> int:
        """How many scripts pigpiod holds."""
        with self.client() as client:
            return sum(bool(client.script_status(script)[1]) for script in range(32))

    def refuse(self, command: int, value: int) -> None:
        """From now on pigpiod refuses this command with this second parameter."""
        commands = self.daemon._commands
        execute = commands.execute

        def refusing(
            time: float, number: int, p1: int, p2: int, extension: bytes
        ) -> tuple[int, bytes]:
            if (number, p2) == (command, value):
                return errors.NOT_PERMITTED, b""
            return execute(time, number, p1, p2, extension)

        commands.execute = refusing  # type: ignore[method-assign]

    def hang_up_in_next_sleep(self) -> None:
        """Pigpiod ends all connections while fishd sleeps the next time; pulses go on."""
        sleep = self.clock.sleep

        def hang_up(seconds: float) -> None:
            self.clock.sleep = sleep  # type: ignore[method-assign]
            for connection in list(self.daemon._connections.values()):
                connection.hang_up()
            sleep(seconds)

        self.clock.sleep = hang_up  # type: ignore[method-assign]

    def changes_after(self, time: float) -> list[tuple[float, float]]:
        return [(when, width) for when, width in self.daemon.history(GPIO) if when > time]


def connect(servo: PigpioServo) -> None:
    """Connect, but neither write nor release."""
    with servo._link.session():
        pass
