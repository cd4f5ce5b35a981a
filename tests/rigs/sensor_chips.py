"""Chips of sensors, emulated at the level of their registers for an `I2cBus`, and a 1-wire bus."""

import errno
import struct
from pathlib import Path
from typing import Any, Self

from fishd.core.clock import VirtualClock
from fishd.virtual.pi.faults import Faults
from fishd.virtual.pi.i2c import I2cBus, kernel_error
from fishd.virtual.pi.linux_i2c import LinuxI2c

BUS = 205
"""Bus that does not exist on any machine."""


class SensorBoard:
    """A chip at an address of an emulated bus; a context manager."""

    def __init__(self, address: int, chip: Any) -> None:
        self.clock = VirtualClock()
        self.faults = Faults(self.clock)
        self.chip = chip
        self.bus = I2cBus(self.clock, 400e3, self.faults)
        self.bus.attach(address, chip)
        self.device = LinuxI2c(self.bus.transfer, {BUS}, lambda seconds: None)

    def __enter__(self) -> Self:
        self.device.install()
        return self

    def __exit__(self, *_: object) -> None:
        self.device.remove()


class Chip:
    """A chip that can be unplugged."""

    plugged_in = True

    def write(self, data: bytes) -> None:
        self.check_power()
        self.receive(data)

    def read(self, length: int) -> bytes:
        self.check_power()
        return self.answer(length)

    def check_power(self) -> None:
        if not self.plugged_in:
            raise kernel_error(errno.EREMOTEIO)

    def receive(self, data: bytes) -> None:
        raise NotImplementedError

    def answer(self, length: int) -> bytes:
        raise NotImplementedError


class Lsm6dsoxChip(Chip):
    """LSM6DSOX; data sheet: ST, DS12814. Its outputs follow its ranges and its data rates."""

    WHO_AM_I, CTRL1_XL, CTRL2_G, CTRL3_C, OUTX_L_G, OUTX_L_A = 0x0F, 0x10, 0x11, 0x12, 0x22, 0x28
    MG_PER_STEP = (0.061, 0.488, 0.122, 0.244)
    """By the bits of the range: 2, 16, 4 and 8 g."""
    MDPS_PER_STEP = (8.75, 17.5, 35.0, 70.0)

    def __init__(self) -> None:
        self.acceleration = (0.0, 0.0, 9.80665)
        """[m/s²]"""
        self.rotation = (0.0, 0.0, 0.0)
        """[degrees/s]"""
        self.reset()

    def reset(self) -> None:
        """Reset as after power-on: both sensors are off."""
        self.registers = bytearray(256)
        self.registers[self.WHO_AM_I], self.registers[self.CTRL3_C] = 0x6C, 0x04
        self._pointer = 0

    def receive(self, data: bytes) -> None:
        if not data:  # a probe of the address
            return
        self._pointer = data[0]
        for offset, value in enumerate(data[1:]):
            self.registers[data[0] + offset] = value
        if self.registers[self.CTRL3_C] & 0x01:  # software reset
            self.reset()

    def answer(self, length: int) -> bytes:
        self._measure()
        return bytes(self.registers[self._pointer : self._pointer + length])

    def _measure(self) -> None:
        accelerometer, gyroscope = self.registers[self.CTRL1_XL], self.registers[self.CTRL2_G]
        mg, mdps = (
            self.MG_PER_STEP[accelerometer >> 2 & 3],
            4.375 if gyroscope & 2 else self.MDPS_PER_STEP[gyroscope >> 2 & 3],
        )
        for register, on, values, step in (
            (self.OUTX_L_A, accelerometer >> 4, self.acceleration, mg * 9.80665e-3),
            (self.OUTX_L_G, gyroscope >> 4, self.rotation, mdps * 1e-3),
        ):
            codes = [max(-32768, min(32767, round(value / step))) for value in values]
            self.registers[register : register + 6] = (
                struct.pack("<hhh", *codes) if on else bytes(6)
            )


class KellerChip(Chip):
    """Keller LD with a range of 0 to 3 MPa."""

    def __init__(self, clock: VirtualClock | None = None) -> None:
        self.clock = clock
        self.pressure, self.temperature = 101_325.0, 21.35
        self._ready_at = 0.0

    def receive(self, data: bytes) -> None:
        assert data == b"\xac"
        assert self.clock
        self._ready_at = self.clock.monotonic() + 8e-3

    def answer(self, length: int) -> bytes:
        assert self.clock
        busy = 0x20 if self.clock.monotonic() < self._ready_at else 0
        pressure = round(16384 + 32768 * self.pressure / 3e6)
        temperature = round((self.temperature + 50.0) / 0.05 + 24) << 4
        return struct.pack(">BHH", 0x40 | busy, pressure, temperature)[:length]


def plug_thermometer(folder: Path, device: str, celsius: float, *, good: bool = True) -> Path:
    """Write what the kernel shows of a DS18B20; return its folder."""
    place = folder / device
    place.mkdir(exist_ok=True)
    data = "72 01 4b 46 7f ff 0e 10 57"
    check = "YES" if good else "NO"
    (place / "w1_slave").write_text(f"{data} : crc=57 {check}\n{data} t={round(celsius * 1e3)}\n")
    return place
