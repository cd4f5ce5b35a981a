"""Operator's panel on pins of the header: an E-stop button and a status light."""

import logging
import threading
from collections.abc import Callable

from fishd.core.clock import Clock
from fishd.core.errors import StartupError
from fishd.hardware import header
from fishd.hardware.settings import PanelSettings

log = logging.getLogger(__name__)

BOUNCE_MS = 5
"""Time for which the contact of a button may bounce [ms]."""
RELEASED_POLLS = 2
"""Number of polls in a row that must find the button released; a press takes effect at once."""


class RpiGpioPanel:
    """Button and light through RPi.GPIO or rpi-lgpio; either may be absent.

    The button is a contact to ground, and a pull-up makes the level high while it is open. A button
    that opens when pressed (`estop_pressed: high`) also counts as pressed if its wire is broken.
    """

    def __init__(self, settings: PanelSettings, clock: Clock) -> None:
        """Claim the pins; raise `StartupError` if that is not possible."""
        self.on_press: Callable[[], None] = _nothing
        """Function called, from any thread, as soon as the button is pressed, between ticks too."""
        self._settings = settings
        self._pressed = False
        self._released_polls = 0
        self._lock = threading.Lock()  # the library calls back from its own thread
        self._lit = False
        self._changed = 0.0
        self._dark = settings.led_gpio is None
        self._pins = [p for p in (settings.estop_gpio, settings.led_gpio) if p is not None]
        self._closed = not self._pins
        if self._pins:
            self._gpio = header.load()
            self._claim(clock)

    def update(self, mode: str, now: float) -> bool:
        """Show the mode on the light in each tick; return True while the button is pressed.

        now: time of the tick [s]
        Raises OSError when the button cannot be read.
        """
        self._show(self._should_light(mode, now), now)
        if self._settings.estop_gpio is None:
            return False
        try:
            down = self._is_down()
        except Exception as error:  # lgpio.error is a bare Exception
            raise OSError(
                f"E-stop button on GPIO {self._settings.estop_gpio}: {header.format_error(error)}"
            ) from None
        with self._lock:
            if down:
                self._pressed, self._released_polls = True, 0
            else:
                self._released_polls += 1
                if self._released_polls >= RELEASED_POLLS:
                    self._pressed = False
            return self._pressed

    def close(self) -> None:
        """Switch the light off and release the pins; may be called twice.

        A step that fails is logged, and the next one is still done.
        """
        if self._closed:
            return
        self._closed = True
        self.on_press = _nothing
        if not self._dark:
            self._attempt("switch off", self._gpio.output, self._settings.led_gpio, self._gpio.LOW)
        for pin in self._pins:  # cleanup() without a pin takes those of everybody
            self._attempt("give back", self._gpio.cleanup, pin)

    def _claim(self, clock: Clock) -> None:
        gpio, settings = self._gpio, self._settings
        pin = 0
        try:
            for pin in self._pins:
                if pin == settings.led_gpio:
                    header.claim(gpio, pin, gpio.OUT, initial=gpio.LOW)
                else:
                    header.claim(gpio, pin, gpio.IN, pull_up_down=gpio.PUD_UP)
        except Exception as error:
            raise StartupError(
                f"GPIO {pin} cannot be used for the panel: {header.format_error(error)}"
            ) from None
        if settings.estop_gpio is not None:
            clock.sleep(0.001)  # the pull-up has to charge the wire first
            self._listen(settings.estop_gpio)

    def _listen(self, pin: int) -> None:
        """Ask the library to report presses at once; if it cannot, only ticks poll the button."""
        try:
            self._gpio.add_event_detect(pin, self._gpio.BOTH, self._on_edge, BOUNCE_MS)
        except Exception as error:
            # RPi.GPIO cannot do it on Linux 6.6 and later.
            log.warning(
                "E-stop button on GPIO %d is polled only, once a tick: %s; "
                "rpi-lgpio instead of RPi.GPIO would report it at once",
                pin,
                header.format_error(error),
            )

    def _on_edge(self, pin: int) -> None:
        try:
            down = self._is_down()  # a short spike has already gone
        except Exception as error:
            log.warning("E-stop button on GPIO %d: %s", pin, header.format_error(error))
            return
        with self._lock:
            new = down and not self._pressed
            if down:
                self._pressed, self._released_polls = True, 0
        if new:
            self.on_press()

    def _is_down(self) -> bool:
        level = self._gpio.input(self._settings.estop_gpio)
        return bool(level) == (self._settings.estop_pressed == "high")

    def _should_light(self, mode: str, now: float) -> bool:
        if mode == "running":
            return True
        if mode == "idle":  # a flash each second, as long as the longest tick
            return now % 1.0 < 0.2
        # Blink at 5 Hz, or at half the rate of slow ticks. The phase of the clock cannot be used:
        # at some tick rates every tick would fall into the same half.
        return self._lit if now - self._changed < 0.09 else not self._lit

    def _show(self, lit: bool, now: float) -> None:
        """Switch the light; a light that fails is reported once and does not stop the fish."""
        if self._dark or lit == self._lit:
            return
        self._lit = lit
        self._changed = now
        try:
            self._gpio.output(self._settings.led_gpio, int(lit))
        except Exception as error:
            self._dark = True
            log.warning(
                "the status light on GPIO %d stays dark: %s",
                self._settings.led_gpio,
                header.format_error(error),
            )

    def _attempt(self, what: str, step: Callable[..., object], pin: int | None, *more: int) -> None:
        try:
            step(pin, *more)
        except Exception as error:
            log.warning("cannot %s GPIO %s: %s", what, pin, header.format_error(error))


def _nothing() -> None:
    """Do nothing: the default of `on_press`."""
