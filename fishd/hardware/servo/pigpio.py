"""The servo on a Pi 4 or older: pulses by pigpiod, over a link that may come and go.

A countdown script inside pigpiod ends the pulses when fishd no longer writes, whatever ended it.
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

if TYPE_CHECKING:  # the library is loaded only by whoever drives a servo with it
    from fishd.hardware.servo.pigpio_client import Client

SLOW_ANSWER = 5e-3
"""An answer of pigpiod that takes longer may keep a tick waiting [s]."""
_LOCAL = ("127.0.0.1", "localhost", "::1")


class PigpioSettings(ServoSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which pin, where pigpiod is, and how long it may take."""

    gpio: Annotated[Gpio, note("Pin of the servo's signal, Broadcom number.")] = 18
    host: Annotated[str, note("Host of pigpiod.")] = "127.0.0.1"
    port: Annotated[int, note("Its TCP port.", ge=1, le=65535)] = 8888
    timeout: Annotated[
        float,
        unit(
            "s",
            "Longest that pigpiod may keep a tick waiting; then the servo keeps its angle for a "
            "tick. The third time in a row the link is lost.",
            ge=0.001,
            le=0.1,
        ),
    ] = 0.008
    countdown: Annotated[
        float,
        unit(
            "s",
            "Without a tick for this time, three ticks at least, pigpiod takes the servo to rest, "
            "and fishd is in fault if it goes on. Longer forgives a busy machine.",
            ge=0.1,
            le=2.0,
        ),
    ] = 0.2


class Pigpio(ServoDriver[PigpioSettings]):
    """A servo on any pin, through pigpiod."""

    Settings = PigpioSettings
    packages = ("pigpio",)
    on_virtual_pi = True

    def __init__(
        self, *given: Any, standstill: Callable[[], bool] | None = None, **named: Any
    ) -> None:
        """standstill: as for `PigpioLink`"""
        self._standstill = standstill
        super().__init__(*given, **named)

    def open(self) -> None:
        """Connect within 2 s, or go on without and keep trying; in virtual time `write` does."""
        from fishd.hardware.servo import pigpio_link, pigpio_pulses

        self._pulses = pigpio_pulses
        self._counts = pigpio_pulses.counts(self.settings.countdown, self.tick)
        self.countdown = pigpio_pulses.COUNT * self._counts
        self._script = -1
        self._energised = False
        self._armed = 0.0  # when the latest countdown that pigpiod has confirmed was sent
        self._closed = False
        self._link = pigpio_link.PigpioLink(
            self.settings,
            self.clock,
            self._prepare,
            threaded=self.threaded,
            standstill=self._standstill,
        )

    def write(self, pulse: float) -> None:
        """Arm the countdown, and send a pulse [µs].

        An answer that comes late is no error: the servo keeps its angle for a tick. Raises
        `ServoError` at the third in a row, or before the countdown could end.
        """
        with self._link.session(forgives=self._has_time) as client:
            late = client.owed
            client.settle()
            now = self.clock.monotonic()
            if late and self._energised and now - self._armed > self.countdown:
                raise ConnectionError("it answered so late that the servo may be at rest by now")
            # First the countdown: whatever happens next, these pulses will have an end.
            countdown = self._pulses.armed(self.settings.gpio, self._counts, self.neutral)
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

        Raises `ServoError`, once all that could be done is done, if pulses may still be on.
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
        """How often the link was made again since start, and how many answers came late."""
        return {
            "servo_reconnects": self._link.reconnects,
            "servo_late_answers": self._link.late_answers,
        }

    @classmethod
    def check(cls, settings: PigpioSettings, tick: float) -> None:
        """There is a host."""
        if not re.fullmatch(r"\S+", settings.host):
            raise Problem(
                ("host",), f"'{settings.host}' is not valid: a host is needed, such as 127.0.0.1"
            )

    @classmethod
    def claims(cls, settings: PigpioSettings) -> tuple[Claim, ...]:
        """Its pin, of this machine or of another one."""
        claim = pin(settings.gpio, "servo")
        if settings.host in _LOCAL:
            return (claim,)
        place = f"{settings.host}:{settings.port}"
        return (Claim(f"{place}-{claim.name}", f"{claim.what} of {place}", claim.key),)

    @classmethod
    def checks(cls, settings: PigpioSettings) -> tuple[Check, ...]:
        """Of pigpiod."""
        return (Check("pigpiod", lambda machine: _pigpiod(machine, settings)),)

    @classmethod
    def last_resort(cls, settings: PigpioSettings) -> LastResort:
        """Pulses outlive fishd for as long as the countdown, and longer if others made them."""
        return LastResort(
            "fishd.hardware.servo.pigpio_pulses:neutralise",
            {"gpio": settings.gpio, "host": settings.host, "port": settings.port},
        )

    @classmethod
    def read_pulses(cls, settings: PigpioSettings) -> bool:
        """Ask pigpiod."""
        from fishd.hardware.servo.pigpio_client import opened
        from fishd.hardware.servo.pigpio_pulses import pulses_on

        with opened(settings.host, settings.port) as client:
            return pulses_on(client, settings.gpio, time.sleep)

    def _has_time(self) -> bool:
        """Whether the countdown leaves time for another tick."""
        silence = self.clock.monotonic() - self._armed
        return not self._energised or silence + self.tick < self.countdown

    def _off(self, client: "Client") -> None:
        gpio = self.settings.gpio
        failure: Exception | None = None
        try:
            # Not disarmed but armed with OFF: if this alone arrives, it ends the pulses.
            client.update_script(self._script, self._pulses.armed(gpio, 1, self._pulses.OFF))
        except client.refusal as error:
            failure = error
        client.set_servo_pulsewidth(gpio, self._pulses.OFF)
        self._energised = False
        if failure:
            raise failure

    def _prepare(self, client: "Client") -> None:
        """Put a new connection in order: no pulses go on unless the loop writes again.

        The scripts of those before stay armed until that of this connection is. It ends pulses that
        the bytes of a lost connection, or of a killed fishd, still bring.
        """
        gpio, sleep = self.settings.gpio, self.clock.sleep
        former = self._pulses.countdowns(client, gpio)
        count, width = self._counts, float(self._pulses.OFF)
        if not self._energised and self._pulses.pulses_on(client, gpio, sleep):
            count, width = 1, self.neutral  # of a killed fishd: gently
        self._script = self._pulses.install(client, gpio, count, width, sleep)
        if self._energised:
            client.set_servo_pulsewidth(gpio, self._pulses.OFF)
        self._pulses.remove(client, former)
        self._energised = False


def _pigpiod(machine: Machine, settings: PigpioSettings) -> Result:
    """Through the client that fishd itself uses, whose every step has a time limit."""
    virtual = machine.robot == "virtual-pi"
    if not virtual and "Raspberry Pi 5" in machine.model:
        return fail("pigpio does not work on a Pi 5", "set servo.driver: sysfs-pwm")
    from fishd.hardware.servo.pigpio_client import opened

    try:
        with opened(settings.host, settings.port) as client:
            began = time.monotonic()
            version = client.get_pigpio_version()
            took = time.monotonic() - began
    except ServoError as error:
        frozen = "answer" in str(error)
        if virtual:
            mend = f"{START_VIRTUAL_PI}; its port must be that of servo.port"
        elif frozen:
            mend = "sudo systemctl restart pigpiod"
        else:
            mend = _start_pigpiod(machine)
        return fail(str(error), mend)
    message = f"version {version} answers in {took * 1e3:.2f} ms"
    if took > SLOW_ANSWER:
        return warning(f"{message}: too slow for a tick", "see what else loads this machine")
    return ok(message)


def _start_pigpiod(machine: Machine) -> str:
    """What to do where nobody answers: Debian has no package of it, Raspberry Pi OS 12 has."""
    if any(machine.path(f"{folder}/pigpiod").exists() for folder in ("/usr/bin", "/usr/local/bin")):
        return "sudo systemctl enable --now pigpiod"
    if machine.path("/etc/rpi-issue").exists():
        return "sudo apt install pigpio; where there is no such package, servo.driver: sysfs-pwm"
    return "Debian has no pigpiod: set servo.driver: sysfs-pwm, or build it from its sources"
