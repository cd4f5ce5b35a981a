"""What the configuration says about the virtual Pi: how its parts are wired to the fish."""

from typing import Annotated

from msgspec import Meta, Struct

from fishd.hardware.settings import Channel, Gpio


class VirtualPiSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The virtual Pi as it is built; `force_sensor` and `servo` say what fishd believes of it."""

    socket: Annotated[
        str | None,
        Meta(
            description="Unix socket on which the virtual Pi is reached; null: virtual-pi in "
            "$XDG_RUNTIME_DIR/fishd, else in a private folder under /tmp."
        ),
    ] = None
    bus: Annotated[int, Meta(ge=0, le=255, description="I2C bus that the ADS1115 is on.")] = 1
    address: Annotated[int, Meta(ge=0x48, le=0x4B, description="I2C address of the ADS1115.")] = 72
    bus_speed: Annotated[
        float,
        Meta(
            ge=10e3,
            le=1e6,
            description="Speed of the I2C bus.",
            extra_json_schema={"unit": "bit/s"},
        ),
    ] = 400e3
    channel_x: Annotated[Channel, Meta(description="Input that F_x is wired to.")] = "A0-A1"
    channel_y: Annotated[Channel, Meta(description="Input that F_y is wired to.")] = "A2-A3"
    sensitivity: Annotated[
        float,
        Meta(
            gt=0,
            le=1e3,
            description="Voltage per force, on both channels.",
            extra_json_schema={"unit": "V/N"},
        ),
    ] = 1.0
    crosstalk: Annotated[
        float,
        Meta(
            ge=-0.5,
            le=0.5,
            description="Share of each force that shows on the other channel.",
            extra_json_schema={"unit": "1"},
        ),
    ] = 0.0
    zero_x: Annotated[
        float,
        Meta(
            ge=-5,
            le=5,
            description="Voltage of channel_x without a force.",
            extra_json_schema={"unit": "V"},
        ),
    ] = 0.0
    zero_y: Annotated[
        float,
        Meta(
            ge=-5,
            le=5,
            description="Voltage of channel_y without a force.",
            extra_json_schema={"unit": "V"},
        ),
    ] = 0.0
    adc_noise: Annotated[
        float,
        Meta(
            ge=0,
            le=100,
            description="Noise of a conversion, rms, in steps of the ADC.",
            extra_json_schema={"unit": "1"},
        ),
    ] = 1.0
    pigpio_port: Annotated[
        int, Meta(ge=0, le=65535, description="TCP port of its pigpiod; 0 takes a free one.")
    ] = 8888
    servo_gpio: Annotated[Gpio, Meta(description="Pin that the servo's signal is wired to.")] = 18
    servo_centre: Annotated[
        float,
        Meta(
            ge=500,
            le=2500,
            description="Pulse at which the fin is straight.",
            extra_json_schema={"unit": "us"},
        ),
    ] = 1500.0
    servo_scale: Annotated[
        float,
        Meta(
            ge=-5000,
            le=5000,
            description="Change of the pulse per angle of the wheel; negative where the servo is "
            "mounted the other way round.",
            extra_json_schema={"unit": "us/rad"},
        ),
    ] = 600.0
