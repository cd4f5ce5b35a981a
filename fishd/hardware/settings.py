"""What the configuration says about the hardware: force sensor, servo and operator's panel."""

import math
from typing import Annotated, Literal

from msgspec import Meta, Struct

Gpio = Annotated[int, Meta(ge=0, le=27)]
"""A pin of the Pi's 40-pin header, by its Broadcom number."""

Channel = Literal["A0", "A1", "A2", "A3", "A0-A1", "A0-A3", "A1-A3", "A2-A3"]
"""An input of the ADS1115: a pin against ground, or the difference of two."""


FULL_SCALES = (6.144, 4.096, 2.048, 1.024, 0.512, 0.256)
"""The ranges that the ADS1115 has, ± [V]."""


class ForceSensorSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The ADS1115 that the dual force sensor is wired to."""

    bus: Annotated[int, Meta(ge=0, le=255, description="I2C bus: N of /dev/i2c-N.")] = 1
    address: Annotated[
        int, Meta(ge=0x48, le=0x4B, description="I2C address, set by the ADDR pin; 72 is 0x48.")
    ] = 72
    channel_x: Annotated[Channel, Meta(description="Input that carries F_x.")] = "A0-A1"
    channel_y: Annotated[Channel, Meta(description="Input that carries F_y.")] = "A2-A3"
    full_scale: Annotated[
        float,
        Meta(
            gt=0,
            le=6.144,
            description="Range of the inputs, ± this: 6.144, 4.096, 2.048, 1.024, 0.512 or 0.256.",
            extra_json_schema={"unit": "V"},
        ),
    ] = 2.048
    saturation_low: Annotated[
        Annotated[float, Meta(ge=-6.144, le=6.144)] | None,
        Meta(
            description="At or below, an amplifier is at the end of its supply: as if the ADC had "
            "clipped. Between the pins of the input, so 0.1 for A0 alone; null for none.",
            extra_json_schema={"unit": "V"},
        ),
    ] = -3.2
    saturation_high: Annotated[
        Annotated[float, Meta(ge=-6.144, le=6.144)] | None,
        Meta(
            description="The same at or above. An amplifier at 3.3 V ends below a full_scale of "
            "4.096 or 6.144, where the ADC itself does not clip; null for none.",
            extra_json_schema={"unit": "V"},
        ),
    ] = 3.2
    data_rate: Annotated[
        Literal[8, 16, 32, 64, 128, 250, 475, 860],
        Meta(description="Conversions per second.", extra_json_schema={"unit": "1/s"}),
    ] = 860
    force_limit: Annotated[
        float,
        Meta(
            gt=0,
            le=1e4,
            description="A force beyond ± this is not believed.",
            extra_json_schema={"unit": "N"},
        ),
    ] = 10.0
    still: Annotated[
        float,
        Meta(
            gt=0,
            le=1e3,
            description="Noise of single samples, rms, up to which a tare is permitted.",
            extra_json_schema={"unit": "N"},
        ),
    ] = 0.02
    tare_limit: Annotated[
        float,
        Meta(
            gt=0,
            le=1e4,
            description="Largest force that a tare takes away.",
            extra_json_schema={"unit": "N"},
        ),
    ] = 1.0
    frozen_after: Annotated[
        Annotated[float, Meta(ge=0.1, le=600)] | None,
        Meta(
            description="A channel whose code has not changed for so long is not believed; "
            "null where the signal is quieter than one step of the ADC.",
            extra_json_schema={"unit": "s"},
        ),
    ] = 2.0


class PigpioSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Where pigpiod is, and how long it may take."""

    host: Annotated[str, Meta(description="Host of pigpiod.")] = "127.0.0.1"
    port: Annotated[int, Meta(ge=1, le=65535, description="Its TCP port.")] = 8888
    timeout: Annotated[
        float,
        Meta(
            ge=0.001,
            le=0.1,
            description="Longest that pigpiod may keep a tick waiting; then the servo keeps its "
            "angle for a tick. The third time in a row the link is lost.",
            extra_json_schema={"unit": "s"},
        ),
    ] = 0.008
    countdown: Annotated[
        float,
        Meta(
            ge=0.1,
            le=2.0,
            description="Without a tick for so long, three ticks at least, pigpiod takes the servo "
            "to rest, and fishd is in fault if it goes on. Longer forgives a busy machine.",
            extra_json_schema={"unit": "s"},
        ),
    ] = 0.2


class SysfsPwmSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Which channel of the kernel's PWM drives the servo."""

    root: Annotated[str, Meta(description="Folder of the PWM chips.")] = "/sys/class/pwm"
    chip: Annotated[
        str | None,
        Meta(
            description="Device of the chip, such as 1f00098000.pwm; null: that of the Pi's header."
        ),
    ] = None
    channel: Annotated[
        Annotated[int, Meta(ge=0, le=15)] | None,
        Meta(description="Channel of the chip; null: the one that servo.gpio is wired to."),
    ] = None


class ServoSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The tail servo: pulse = centre + trim + direction · scale · angle."""

    driver: Annotated[
        Literal["pigpio", "sysfs-pwm", "rpi-gpio"],
        Meta(
            description="What makes the pulses: pigpiod (Pi 4 and older), the kernel's PWM (Pi 5, "
            "Debian 13), or software PWM, which jitters and is a last resort."
        ),
    ] = "pigpio"
    gpio: Annotated[Gpio, Meta(description="Pin of the servo's signal, Broadcom number.")] = 18
    frequency: Annotated[
        float,
        Meta(
            ge=40,
            le=333,
            description="Pulses per second; more than 50 for digital servos only, and not with "
            "pigpio.",
            extra_json_schema={"unit": "Hz"},
        ),
    ] = 50.0
    centre: Annotated[
        float,
        Meta(
            ge=500,
            le=2500,
            description="Pulse of the servo's mid position.",
            extra_json_schema={"unit": "us"},
        ),
    ] = 1500.0
    trim: Annotated[
        float,
        Meta(
            ge=-500,
            le=500,
            description="Correction of the centre that makes the fin straight.",
            extra_json_schema={"unit": "us"},
        ),
    ] = 0.0
    direction: Annotated[
        Literal[1, -1], Meta(description="1 or -1: which way a positive angle turns.")
    ] = 1
    scale: Annotated[
        float,
        Meta(
            ge=10,
            le=5000,
            description="Change of the pulse per angle.",
            extra_json_schema={"unit": "us/rad"},
        ),
    ] = 600.0
    lowest: Annotated[
        float,
        Meta(
            ge=-math.pi,
            le=0,
            description="Soft limit: no angle below.",
            extra_json_schema={"unit": "rad"},
        ),
    ] = -1.2
    highest: Annotated[
        float,
        Meta(
            ge=0,
            le=math.pi,
            description="Soft limit: no angle above.",
            extra_json_schema={"unit": "rad"},
        ),
    ] = 1.2
    pigpio: Annotated[PigpioSettings, Meta(description="With driver pigpio.")] = PigpioSettings()
    sysfs: Annotated[SysfsPwmSettings, Meta(description="With driver sysfs-pwm.")] = (
        SysfsPwmSettings()
    )


class PanelSettings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The operator's panel: an E-stop button and a status light."""

    estop_gpio: Annotated[
        Gpio | None, Meta(description="Pin of the E-stop button; null without one.")
    ] = None
    estop_pressed: Annotated[
        Literal["low", "high"],
        Meta(
            description="Level of that pin while the button is pressed. With high, a button that "
            "opens a contact to ground, a broken wire stops the fish too."
        ),
    ] = "high"
    led_gpio: Annotated[
        Gpio | None, Meta(description="Pin of the status light; null without one.")
    ] = None
