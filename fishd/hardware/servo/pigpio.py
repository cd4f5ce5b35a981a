"""Servo on a Pi 4 or older: pulses by pigpiod, over a link that is made again when it breaks.

A countdown script inside pigpiod ends the pulses when fishd stops writing for any reason.
"""

import re
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any

from fishd.core.errors import ServoError
from fishd.core.schema import Problem, note, unit
from fishd.hardware.checks import START_VIRTUAL_PI, Check, Machine, Result, fail, ok, warning
from fishd.hardware.driver import Claim, LastResort, ServoDriver, pin
from fishd.hardware.settings import Gpio, ServoSettings

if TYPE_CHECKING:  # the library is loaded only if a servo is driven with it
    from fishd.hardware.servo.pigpio_client import Client

SLOW_ANSWER_S = 5e-3
"""Longest answer time of pigpiod that cannot delay a tick [s]."""
_LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")


class PigpioSettings(ServoSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pin of the servo, address of pigpiod, and its time limits."""

    gpio: Annotated[Gpio, note("Pin of the servo's signal, Broadcom number.")] = 18
    host: Annotated[str, note("Host of pigpiod.")] = "127.0.0.1"
    port: Annotated[int, note("TCP port of pigpiod.", ge=1, le=65535)] = 8888
    timeout: Annotated[
        float,
        unit(
            "s",
            "Longest time that a tick waits for pigpiod; then the servo keeps its angle for that "
            "tick. After the third time in a row, fishd connects again.",
            ge=0.001,
            le=0.1,
        ),
    ] = 0.008
    countdown: Annotated[
        float,
        unit(
            "s",
            "Time without a tick, at least three ticks, after which pigpiod takes the servo to "
            "neutral and ends its pulses. A longer time tolerates a busy machine.",
            ge=0.1,
            le=2.0,
        ),
    ] = 0.2

    @property
    def pulse_steps(self) -> tuple[float, ...]:
        """Likely steps of pigpiod, its option -s [µs]: that of fishd's service, and the default.

        Forces do not tell 5 from 10 for certain, so the unusual steps are not considered.
        """
        return (1.0, 5.0)


class Pigpio(ServoDriver[PigpioSettings]):
    """A servo on any pin, through pigpiod."""

    Settings = PigpioSettings
    packages = ("pigpio",)
    on_virtual_pi = True

    def __init__(
        self, *given: Any, standstill: Callable[[], bool] | None = None, **named: Any
    ) -> None:
        """Do as `ServoDriver`; `standstill` is that of `PigpioLink`."""
        self._standstill = standstill
        super().__init__(*given, **named)

    def open(self) -> None:
        """Connect within 2 s, or keep trying in a thread; in virtual time each write tries."""
        from fishd.hardware.servo import pigpio_link, pigpio_pulses

        self._pulses = pigpio_pulses
        self._counts = pigpio_pulses.countdown_counts(self.settings.countdown, self.tick)
        self.countdown = pigpio_pulses.COUNT_S * self._counts
        self._script = -1
        self._energised = False
        self._armed = 0.0  # time when the latest countdown that pigpiod confirmed was sent
        self._closed = False
        self._link = pigpio_link.PigpioLink(
            (self.settings.host, self.settings.port),
            self.settings.timeout,
            self.clock,
            self._prepare,
            threaded=self.threaded,
            standstill=self._standstill,
        )

    def write(self, pulse: float) -> None:
        """Arm the countdown, and send a pulse [µs].

        A late answer is not an error: the servo keeps its angle for a tick. Raises `ServoError` at
        the third late answer in a row, or before the countdown could end.
        """
        with self._link.session(may_be_late=self._has_time) as client:
            late = client.unanswered
            client.settle()
            now = self.clock.monotonic()
            if late and self._energised and now - self._armed > self.countdown:
                raise ConnectionError(
                    "it answered so late that its countdown may have released the servo"
                )
            # First the countdown: whatever happens next, these pulses will have an end.
            countdown = self._pulses.armed_parameters(
                self.settings.gpio, self._counts, self.neutral
            )
            client.update_script(self._script, countdown)
            self._armed = now
            self._energised = True
            client.set_servo_pulsewidth(self.settings.gpio, round(pulse))

    def off(self) -> None:
        """Stop the pulses and disarm the countdown; may be called twice."""
        with self._link.session() as client:
            self._off(client)

    def close(self) -> None:
        """End the pulses, remove the script and disconnect; may be called twice.

        Raises `ServoError`, after all other steps, if pulses may still be on.
        """
        if self._closed:
            return
        self._closed = True
        try:
            with self._link.session(last=True) as client:
                self._off(client)
                client.delete_script(self._script)
        except ServoError:
            if self._energised:
                raise
        finally:
            self._link.close()

    def counters(self) -> dict[str, int]:
        """Return the numbers of reconnections and of late answers since start."""
        return {
            "servo_reconnects": self._link.reconnects,
            "servo_late_answers": self._link.late_answers,
        }

    @classmethod
    def check(cls, settings: PigpioSettings, tick: float) -> None:
        """Refuse a host that is empty or contains spaces."""
        if not re.fullmatch(r"\S+", settings.host):
            raise Problem(
                ("host",), f"'{settings.host}' is not valid: a host is needed, such as 127.0.0.1"
            )

    @classmethod
    def claims(cls, settings: PigpioSettings) -> tuple[Claim, ...]:
        """Return the claim of the pin, of this machine or of another one."""
        claim = pin(settings.gpio, "servo")
        if settings.host in _LOCAL_HOSTS:
            return (claim,)
        place = f"{settings.host}:{settings.port}"
        return (Claim(f"{place}-{claim.name}", f"{claim.what} of {place}", claim.key),)

    @classmethod
    def checks(cls, settings: PigpioSettings) -> tuple[Check, ...]:
        """Return the check of pigpiod."""
        return (Check("pigpiod", lambda machine: _pigpiod(machine, settings)),)

    @classmethod
    def last_resort(cls, settings: PigpioSettings) -> LastResort:
        """Return how to end pulses, which outlive fishd until the end of the countdown."""
        return LastResort(
            "fishd.hardware.servo.pigpio_pulses:neutralise",
            {"gpio": settings.gpio, "host": settings.host, "port": settings.port},
        )

    @classmethod
    def read_pulses(cls, settings: PigpioSettings) -> bool:
        """Read back from pigpiod whether there are pulses."""
        from fishd.hardware.servo.pigpio_client import open_client
        from fishd.hardware.servo.pigpio_pulses import pulses_on

        with open_client(settings.host, settings.port) as client:
            return pulses_on(client, settings.gpio, time.sleep)

    def _has_time(self) -> bool:
        """Return whether the countdown leaves time for another tick."""
        silence = self.clock.monotonic() - self._armed
        return not self._energised or silence + self.tick < self.countdown

    def _off(self, client: "Client") -> None:
        gpio = self.settings.gpio
        failure: Exception | None = None
        try:
            # Not disarmed but armed with OFF: if only this command arrives, it ends the pulses.
            client.update_script(
                self._script, self._pulses.armed_parameters(gpio, 1, self._pulses.OFF)
            )
        except client.refusal as error:
            failure = error
        client.set_servo_pulsewidth(gpio, self._pulses.OFF)
        self._energised = False
        if failure:
            raise failure

    def _prepare(self, client: "Client") -> None:
        """Prepare a new connection, so that no pulses continue unless the loop writes again.

        The scripts of earlier connections stay armed until the script of this one is armed. It also
        ends pulses that start when bytes of a lost connection, or of a killed fishd, arrive late.
        """
        gpio, sleep = self.settings.gpio, self.clock.sleep
        self._pulses.check_commands(client)
        former = self._pulses.find_countdowns(client, gpio)
        count, width = self._counts, float(self._pulses.OFF)
        if not self._energised and self._pulses.pulses_on(client, gpio, sleep):
            count, width = 1, self.neutral  # pulses of a killed fishd end at neutral
        self._script = self._pulses.install(client, gpio, count, width, sleep)
        if self._energised:
            client.set_servo_pulsewidth(gpio, self._pulses.OFF)
        self._pulses.remove(client, former)
        self._energised = False


def _pigpiod(machine: Machine, settings: PigpioSettings) -> Result:
    """Check pigpiod through fishd's own client, which has a time limit for every step."""
    if not machine.is_virtual and "Raspberry Pi 5" in machine.model:
        return fail("pigpio does not work on a Pi 5", "set servo.driver: sysfs-pwm")
    from fishd.hardware.servo.pigpio_client import MissingCommands, open_client
    from fishd.hardware.servo.pigpio_pulses import check_commands

    place = f"{settings.host}:{settings.port}"
    try:
        with open_client(settings.host, settings.port) as client:
            started = time.monotonic()
            version = client.get_pigpio_version()
            duration = time.monotonic() - started
            check_commands(client)
    except MissingCommands as error:
        return fail(str(error), "install pigpio 79, of 2021, or set servo.driver: sysfs-pwm")
    except ServoError as error:
        text = str(error)
        if machine.is_virtual and "not pigpiod: it" not in text:
            remedy = f"{START_VIRTUAL_PI}; its port must be that of servo.port"
        elif not any(word in text for word in ("no answer", "it closed", "not pigpiod")):
            remedy = _start_pigpiod(machine)
        else:
            remedy = (
                f"sudo systemctl restart pigpiod; if another program is at {place} ('sudo ss "
                "-tlnp' names it), stop it, or start pigpiod at another port (-p) and set "
                "servo.port"
            )
        return fail(str(error), remedy)
    message = f"version {version} answers in {duration * 1e3:.2f} ms"
    if duration > SLOW_ANSWER_S:
        return warning(f"{message}: too slow for a tick", "find out what else loads this machine")
    return ok(message)


def _start_pigpiod(machine: Machine) -> str:
    """Return how to start or install pigpiod; Raspberry Pi OS 12 has a package, Debian has none."""
    if any(machine.path(f"{folder}/pigpiod").exists() for folder in ("/usr/bin", "/usr/local/bin")):
        return "sudo systemctl enable --now pigpiod"
    if machine.path("/etc/rpi-issue").exists():
        return "sudo apt install pigpio; if there is no such package, set servo.driver: sysfs-pwm"
    return "Debian has no pigpiod: set servo.driver: sysfs-pwm, or build it from its sources"
