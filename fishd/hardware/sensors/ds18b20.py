"""The thermometer DS18B20 on a 1-wire bus, which the kernel reads (dtoverlay=w1-gpio)."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar

from msgspec import Meta

from fishd.core.schema import Reading, note, unit
from fishd.hardware.driver import SensorDriver, SensorSettings

DEVICES = Path("/sys/bus/w1/devices")
"""Folder in which the kernel lists the devices of its 1-wire buses."""
POWER_ON_VALUE = 85.0
"""Value of a chip that has lost its supply since it was asked to measure [°C]."""


class Ds18b20Settings(SensorSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A DS18B20, whose measurements take 0.75 s."""

    device: Annotated[
        Annotated[str, Meta(pattern="^28-[0-9a-f]{12}$")] | None,
        note("Number of the chip, such as 28-0316a2795aff; null for the only one."),
    ] = None
    period: Annotated[
        Annotated[float, Meta(ge=0.75, le=3600)], unit("s", "Time between two samples.")
    ] = 1.0


class Ds18b20(SensorDriver[Ds18b20Settings]):
    """A thermometer DS18B20 in the water."""

    Settings = Ds18b20Settings
    readings: ClassVar[Mapping[str, Reading]] = {
        "water_temperature": Reading("°C", "Temperature of the water.", 0.0, 50.0)
    }

    @property
    def place(self) -> str:
        """Name of the chip, for messages."""
        return f"the DS18B20 {self.settings.device or 'on the 1-wire bus'}"

    def sample(self) -> dict[str, float]:
        """Measure; raise OSError if the chip does not answer, or not correctly."""
        report = (self._find() / "w1_slave").read_text()
        match = re.search(r"crc=.. YES\n.*t=(-?\d+)", report)
        if not match:
            raise OSError(f"{self.place} answers with errors: check its wires and its pull-up")
        value = int(match[1]) / 1e3
        if value == POWER_ON_VALUE:
            raise OSError(f"{self.place} loses its supply while it measures: check its wires")
        return {"water_temperature": value}

    def _find(self) -> Path:
        """Return the folder of the chip; raise OSError."""
        chips = sorted(DEVICES.glob("28-*"))
        device = self.settings.device
        if device and DEVICES / device in chips:
            return DEVICES / device
        if device is None and len(chips) == 1:
            return chips[0]
        names = ", ".join(chip.name for chip in chips)
        if device is None and chips:
            raise OSError(f"there are several DS18B20: set {self.section}.device to one of {names}")
        raise OSError(
            f"{self.place} is not there: check its wires, dtoverlay=w1-gpio in the Pi's config.txt"
            + (f", and {self.section}.device; there is {names}" if chips else "")
        )

    def explain(self, error: Exception) -> str:
        """Return one line that says what went wrong and what to check."""
        if isinstance(error, OSError) and error.errno is not None:
            return f"{self.place} cannot be read: {error.strerror}: check its wires"
        return super().explain(error)
