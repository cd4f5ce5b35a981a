"""An analogue input of an ADS1115, such as a flow meter, a pressure sensor or a strain gauge."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from fishd.core.clock import Clock
from fishd.core.schema import PRINTABLE, Reading, note, unit
from fishd.hardware.force_sensor.ads1115 import ADC_STEPS, Channel, I2cAddress, check_full_scale
from fishd.hardware.sensors.i2c_sensor import I2cSensor, I2cSensorSettings


class AnalogSettings(I2cSensorSettings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Input of an ADS1115 other than the force sensor's, and its line: scale · voltage + offset."""

    address: Annotated[I2cAddress, note("I2C address, set by the pin ADDR; 73 is 0x49.")] = 73
    channel: Annotated[Channel, note("Input: a pin, or the difference of two.")] = "A0"
    full_scale: Annotated[
        float, unit("V", "Range of the ADC, ±: 6.144, 4.096, 2.048, 1.024, 0.512 or 0.256.")
    ] = 4.096
    data_rate: Annotated[
        Literal[8, 16, 32, 64, 128, 250, 475, 860], unit("1/s", "Conversions per second.")
    ] = 128
    name: Annotated[str, note("Name of the reading.")] = "voltage"
    unit: Annotated[str, note("Unit of the reading.", max_length=20, pattern=PRINTABLE)] = "V"
    description: Annotated[
        str, note("Description of the reading.", max_length=200, pattern=PRINTABLE)
    ] = "Analogue input."
    scale: Annotated[float, note("Change of the reading per volt.", ge=-1e9, le=1e9)] = 1.0
    offset: Annotated[float, note("Reading at 0 V.", ge=-1e9, le=1e9)] = 0.0
    low: Annotated[float | None, note("Value below which it is doubtful; null for none.")] = None
    high: Annotated[float | None, note("Value above which it is doubtful; null for none.")] = None


class AnalogInput(I2cSensor[AnalogSettings]):
    """An analogue input of an ADS1115, with a calibration line."""

    Settings = AnalogSettings
    packages = (*I2cSensor.packages, "adafruit-circuitpython-ads1x15")
    chip = "ADS1115"
    _input: Any

    def __init__(self, settings: AnalogSettings, clock: Clock, period: float, section: str) -> None:
        """Import the library; raise ImportError if it is not installed."""
        from fishd.hardware.force_sensor import ads1115_single_shot as library

        super().__init__(settings, clock, period, section)
        self._library = library
        self.settling = library.CONVERSION_TIMEOUT_PERIODS / settings.data_rate + 1e-3

    @classmethod
    def declare(cls, settings: AnalogSettings) -> Mapping[str, Reading]:
        """Return the one reading, as it is configured."""
        reading = Reading(settings.unit, settings.description, settings.low, settings.high)
        return {settings.name: reading}

    @classmethod
    def check(cls, settings: AnalogSettings, tick: float) -> None:
        """Refuse an impossible range."""
        check_full_scale(settings.full_scale)

    def set_up(self, bus: Any) -> None:
        """Find the chip; raise OSError."""
        settings = self.settings
        chip = self._library.SingleShot(
            bus, settings.address, settings.full_scale, settings.data_rate, self.clock
        )
        self._input = chip.input(settings.channel)

    def sample(self) -> dict[str, float]:
        """Convert once; raise OSError, also at the ends of the range."""
        settings, code = self.settings, int(self._input.value)
        if not -ADC_STEPS < code < ADC_STEPS - 1:
            raise OSError(
                f"{settings.channel} of {self.place} is beyond ±{settings.full_scale:g} V: choose "
                f"a larger {self.section}.full_scale"
            )
        volts = code * settings.full_scale / ADC_STEPS
        return {settings.name: settings.scale * volts + settings.offset}
