"""Settings of every force sensor, servo and other sensor, and of the operator's panel.

A driver adds its own keys in a subclass beside its code.
"""

from typing import Annotated, Any, Literal, Self

import msgspec
from msgspec import Meta, Struct

from fishd.core.calibration import Direction, Highest, Lowest, Scale, ServoCalibration, Trim
from fishd.core.schema import Reading, note, unit

Gpio = Annotated[int, Meta(ge=0, le=27)]
"""Pin of the Pi's 40-pin header, by its Broadcom number."""


class ForceSensorSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The dual force sensor; its driver adds further keys."""

    driver: Annotated[str, note("Name of the driver of the sensor.")] = ""
    force_limit: Annotated[
        float, unit("N", "Largest force, ±; a larger one is not trusted.", gt=0, le=1e4, usual=100)
    ] = 10.0
    still: Annotated[
        float,
        unit(
            "N",
            "Largest noise of single samples, rms, with which a tare is permitted.",
            gt=0,
            le=1e3,
            usual=1,
        ),
    ] = 0.02
    tare_limit: Annotated[
        float, unit("N", "Largest force that a tare may remove.", gt=0, le=1e4, usual=10)
    ] = 1.0
    frozen_after: Annotated[
        Annotated[float, Meta(ge=0.1, le=600)] | None,
        unit(
            "s",
            "Time after which a channel whose code has not changed is not trusted; null if the "
            "signal has less noise than one step of the ADC.",
            usual=60,
        ),
    ] = 2.0


class ServoSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The tail servo: pulse = centre + trim + direction · scale · angle."""

    driver: Annotated[str, note("Name of the driver that makes the pulses.")] = ""
    centre: Annotated[float, unit("us", "Pulse of the servo's mid position.", ge=500, le=2500)] = (
        1500.0
    )
    trim: Trim = 0.0
    direction: Direction = 1
    scale: Scale = 600.0
    lowest: Lowest = -1.2
    highest: Highest = 1.2

    @property
    def pulse_period(self) -> float:
        """Period of the pulses [s]: a new width waits for the next one."""
        return 0.02

    @property
    def pulse_steps(self) -> tuple[float, ...]:
        """Possible steps [µs] to which pulses are rounded down; empty for exact pulses."""
        return ()

    @property
    def calibration(self) -> ServoCalibration:
        """Calibration that the settings themselves contain."""
        return ServoCalibration(**_calibration_values(self))

    def calibrated(self, calibration: ServoCalibration) -> Self:
        """Return the settings with the values of a calibration."""
        return msgspec.structs.replace(self, **_calibration_values(calibration))


POWER = Reading("W", "Electrical power that the servo takes from its supply.")
"""The reading `power`, of a power meter or of the model of a simulated servo."""


class SensorSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A sensor of `sensors`; its kind adds further keys."""

    kind: Annotated[str, note("Name of the driver of the sensor.")] = ""
    required: Annotated[
        bool, note("True: the fault `sensor-lost` while a reading of this sensor is old.")
    ] = False
    period: Annotated[
        Annotated[float, Meta(gt=0, le=3600)] | None,
        unit("s", "Time between two samples; null: as the kind needs it, mostly a tick."),
    ] = None
    stale_after: Annotated[
        Annotated[float, Meta(gt=0, le=86400)] | None,
        unit("s", "Age from which a reading counts as old; null: two ticks, at least 3 periods."),
    ] = None
    rename: Annotated[
        dict[str, str], note("Other names for its readings, such as {power: pump_power}.")
    ] = {}


class PanelSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The operator's panel: an E-stop button and a status light."""

    estop_gpio: Annotated[Gpio | None, note("Pin of the E-stop button; null for none.")] = None
    estop_pressed: Annotated[
        Literal["low", "high"],
        note(
            "Level of that pin while the button is pressed. high is for a button that opens a "
            "contact to ground: then a broken wire also stops the fish."
        ),
    ] = "high"
    led_gpio: Annotated[Gpio | None, note("Pin of the status light; null for none.")] = None

    @property
    def has_pins(self) -> bool:
        """Whether there is a button or a light."""
        return self.estop_gpio is not None or self.led_gpio is not None


def _calibration_values(source: ServoSettings | ServoCalibration) -> dict[str, Any]:
    return {
        key: getattr(source, key) for key in ("trim", "direction", "scale", "lowest", "highest")
    }
