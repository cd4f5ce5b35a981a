"""Settings of the virtual Pi, in particular the wiring of its parts to the fish."""

from typing import Annotated, Literal

from msgspec import Meta, Struct

from fishd.core.schema import note, unit
from fishd.hardware.force_sensor.ads1115 import Channel, I2cAddress
from fishd.hardware.settings import Gpio


class VirtualPiSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """True wiring and scales of the virtual Pi; fishd uses those of `force_sensor` and `servo`."""

    socket: Annotated[
        str | None,
        note(
            "Unix socket of the virtual Pi; null: virtual-pi in "
            "$XDG_RUNTIME_DIR/fishd, else in a private folder under /tmp."
        ),
    ] = None
    bus: Annotated[int, note("I2C bus of the ADS1115.", ge=0, le=255)] = 1
    address: Annotated[I2cAddress, note("I2C address of the ADS1115.")] = 72
    bus_speed: Annotated[float, unit("bit/s", "Speed of the I2C bus.", ge=10e3, le=1e6)] = 400e3
    channel_x: Annotated[Channel, note("Input to which F_x is wired.")] = "A0-A1"
    channel_y: Annotated[Channel, note("Input to which F_y is wired.")] = "A2-A3"
    sensitivity: Annotated[
        float, unit("V/N", "Voltage per force, on both channels.", gt=0, le=1e3)
    ] = 1.0
    crosstalk: Annotated[
        float, unit("1", "Fraction of each force on the other channel.", ge=-0.5, le=0.5)
    ] = 0.0
    zero_x: Annotated[float, unit("V", "Voltage of channel_x at zero force.", ge=-5, le=5)] = 0.0
    zero_y: Annotated[float, unit("V", "Voltage of channel_y at zero force.", ge=-5, le=5)] = 0.0
    adc: Annotated[
        Literal["ads1115", "ads1015"],
        note("ADC: an ADS1115, or an ADS1015 as some shops sell it under that name, with 12 bits."),
    ] = "ads1115"
    adc_noise: Annotated[
        float, unit("1", "RMS noise of a conversion, in steps of an ADS1115.", ge=0, le=100)
    ] = 1.0
    adc_gain: Annotated[
        float, unit("1", "Ratio of the ADC's codes to those of a perfect one.", ge=0.5, le=2)
    ] = 1.0
    loop_gpio: Annotated[
        Gpio | None,
        note(
            "Pin to which a wire from the servo's pin leads, for 'fishctl doctor --bench'; null: "
            "no wire."
        ),
    ] = None
    filter_time: Annotated[
        Annotated[float, Meta(ge=0, le=10)] | None,
        unit(
            "s",
            "Time constant of the filter from the servo's pin to A0, for 'fishctl doctor --bench'. "
            "0: a bare wire; null: the amplifier of the force sensor.",
        ),
    ] = None
    power_meter: Annotated[
        Literal["ina219", "ina226"] | None,
        note("Chip that measures the servo's power, at 0x40 on the same bus; null: none."),
    ] = "ina219"
    shunt: Annotated[
        float, unit("ohm", "Resistance of the power meter's shunt.", ge=1e-4, le=10)
    ] = 0.1
    pigpio_port: Annotated[
        int, note("TCP port of its pigpiod; 0: any free port.", ge=0, le=65535)
    ] = 8888
    pulse_lead: Annotated[
        float,
        unit(
            "s",
            "Time of the first tick of a run in virtual time after the begin of a frame of the "
            "pulses, which is 20 ms long.",
            ge=0,
            lt=0.02,
        ),
    ] = 0.0
    servo_gpio: Annotated[Gpio, note("Pin to which the servo's signal is wired.")] = 18
    servo_centre: Annotated[
        float, unit("us", "Pulse at which the fin is straight.", ge=500, le=2500)
    ] = 1500.0
    servo_scale: Annotated[
        float,
        unit(
            "us/rad",
            "Change of the pulse per angle of the wheel; negative where the servo is mounted in "
            "reverse.",
            ge=-5000,
            le=5000,
        ),
    ] = 600.0
