"""What the configuration says about the virtual Pi: how its parts are wired to the fish."""

from typing import Annotated, Literal

from msgspec import Struct

from fishd.core.schema import note, unit
from fishd.hardware.force_sensor.ads1115 import Channel, I2cAddress
from fishd.hardware.settings import Gpio


class VirtualPiSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The virtual Pi as it is built; `force_sensor` and `servo` say what fishd believes of it."""

    socket: Annotated[
        str | None,
        note(
            "Unix socket on which the virtual Pi is reached; null: virtual-pi in "
            "$XDG_RUNTIME_DIR/fishd, else in a private folder under /tmp."
        ),
    ] = None
    bus: Annotated[int, note("I2C bus that the ADS1115 is on.", ge=0, le=255)] = 1
    address: Annotated[I2cAddress, note("I2C address of the ADS1115.")] = 72
    bus_speed: Annotated[float, unit("bit/s", "Speed of the I2C bus.", ge=10e3, le=1e6)] = 400e3
    channel_x: Annotated[Channel, note("Input that F_x is wired to.")] = "A0-A1"
    channel_y: Annotated[Channel, note("Input that F_y is wired to.")] = "A2-A3"
    sensitivity: Annotated[
        float, unit("V/N", "Voltage per force, on both channels.", gt=0, le=1e3)
    ] = 1.0
    crosstalk: Annotated[
        float, unit("1", "Share of each force that shows on the other channel.", ge=-0.5, le=0.5)
    ] = 0.0
    zero_x: Annotated[float, unit("V", "Voltage of channel_x without a force.", ge=-5, le=5)] = 0.0
    zero_y: Annotated[float, unit("V", "Voltage of channel_y without a force.", ge=-5, le=5)] = 0.0
    adc_noise: Annotated[
        float, unit("1", "Noise of a conversion, rms, in steps of the ADC.", ge=0, le=100)
    ] = 1.0
    power_meter: Annotated[
        Literal["ina219", "ina226"] | None,
        note("Chip that measures the servo's power, at 0x40 on the same bus; null for none."),
    ] = "ina219"
    shunt: Annotated[float, unit("ohm", "Its shunt.", ge=1e-4, le=10)] = 0.1
    pigpio_port: Annotated[
        int, note("TCP port of its pigpiod; 0 takes a free one.", ge=0, le=65535)
    ] = 8888
    servo_gpio: Annotated[Gpio, note("Pin that the servo's signal is wired to.")] = 18
    servo_centre: Annotated[
        float, unit("us", "Pulse at which the fin is straight.", ge=500, le=2500)
    ] = 1500.0
    servo_scale: Annotated[
        float,
        unit(
            "us/rad",
            "Change of the pulse per angle of the wheel; negative where the servo is mounted the "
            "other way round.",
            ge=-5000,
            le=5000,
        ),
    ] = 600.0
