"""Operator's panel on pins of the header: an E-stop button and a status light."""

import logging
import threading
from collections.abc import Callable

from fishd.core.clock import Clock
from fishd.hardware.panel_pins import PanelPins
from fishd.hardware.settings import PanelSettings

log = logging.getLogger(__name__)

RELEASED_POLLS = 2
"""Number of polls in a row that must find the button released; a press takes effect at once."""


class Panel:
    """Button and light; either may be absent.

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
        self._lock = threading.Lock()  # edges are reported by another thread
        self._lit = False
        self._changed = 0.0
        self._dark = settings.led_gpio is None
        self._closed = False
        self._pins: PanelPins | None = None
        if settings.has_pins:
            self._pins = PanelPins(settings.estop_gpio, settings.led_gpio)
            if settings.estop_gpio is not None:
                clock.sleep(0.001)  # the pull-up has to charge the wire first
                self._pins.listen(self._on_edge)

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
        except OSError as error:
            raise OSError(self._describe(error)) from None
        with self._lock:
            if down:
                self._pressed, self._released_polls = True, 0
            else:
                self._released_polls += 1
                if self._released_polls >= RELEASED_POLLS:
                    self._pressed = False
            return self._pressed

    def close(self) -> None:
        """Switch the light off and release the pins; may be called twice."""
        if self._pins is None or self._closed:
            return
        self._closed = True
        self.on_press = _nothing
        if not self._dark:
            self._switch(False)
        self._pins.close()

    def _on_edge(self) -> None:
        try:
            down = self._is_down()  # a short spike has already gone
        except OSError as error:
            log.warning("%s", self._describe(error))
            return
        with self._lock:
            new = down and not self._pressed
            if down:
                self._pressed, self._released_polls = True, 0
        if new:
            self.on_press()

    def _is_down(self) -> bool:
        assert self._pins
        return self._pins.is_high() == (self._settings.estop_pressed == "high")

    def _describe(self, error: OSError) -> str:
        return f"E-stop button on GPIO {self._settings.estop_gpio}: {error.strerror or error}"

    def _should_light(self, mode: str, now: float) -> bool:
        if mode == "running":
            return True
        if mode == "idle":  # a flash each second, as long as the longest tick
            return now % 1.0 < 0.2
        # Blink at 5 Hz, or at half the rate of slow ticks. The phase of the clock cannot be used:
        # at some tick rates every tick would fall into the same half.
        return self._lit if now - self._changed < 0.09 else not self._lit

    def _show(self, lit: bool, now: float) -> None:
        if not self._dark and lit != self._lit:
            self._changed = now
            self._switch(lit)

    def _switch(self, lit: bool) -> None:
        """Switch the light; a light that fails is reported once and does not stop the fish."""
        assert self._pins
        self._lit = lit
        try:
            self._pins.switch(lit)
        except OSError as error:
            self._dark = True
            log.warning(
                "the status light on GPIO %d cannot be switched any more: %s",
                self._settings.led_gpio,
                error.strerror or error,
            )


def _nothing() -> None:
    """Do nothing: the default of `on_press`."""
