"""The comparator of an ADS1115 and its ALERT/RDY pin, as the datasheet describes them."""

from msgspec import Struct

QUEUES = (1, 2, 4, 0)
"""Conversions in a row beyond a threshold before ALERT is asserted, by queue bits; 0: it is off."""

READY_PULSE = 8e-6
"""How long ALERT is asserted after each conversion in continuous mode as a ready pin [s]."""


class Comparator(Struct):
    """Compares each code with two thresholds; switched off by queue bits 3."""

    low: int = -0x8000
    """Lo_thresh, signed."""
    high: int = 0x7FFF
    """Hi_thresh, signed."""
    beyond: int = 0
    """Conversions in a row that were beyond a threshold."""
    asserted: bool = False

    @property
    def ready_pin(self) -> bool:
        """True where the thresholds make ALERT tell that a conversion is ready."""
        return self.high < 0 <= self.low

    def compare(self, code: int, config: int) -> None:
        """Take in the code of a conversion, made with these config bits."""
        queue = QUEUES[config & 3]
        if not queue or self.ready_pin:
            self.beyond, self.asserted = 0, False
            return
        window, latching = bool(config & 0x10), bool(config & 0x04)
        outside = code > self.high or (window and code < self.low)
        inside = self.low <= code <= self.high if window else code < self.low
        self.beyond = self.beyond + 1 if outside else 0
        if self.beyond >= queue:
            self.asserted = True
        elif inside and not latching:
            self.asserted = False

    def result_read(self, config: int) -> None:
        """The conversion register was read: this ends a latched alert."""
        if config & 0x04:
            self.asserted = False
