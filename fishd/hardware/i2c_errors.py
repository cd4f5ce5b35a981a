"""Errors of an I2C transfer in words: what it means for the ADS1115, and what to check."""

import errno
import os

_ADVICE = {
    errno.ENOENT: "{bus} does not exist: enable I2C (dtparam=i2c_arm=on in the Pi's config.txt), "
    "or correct force_sensor.bus",
    errno.EACCES: "{bus} may not be opened: the user of fishd must be in its group, i2c",
    errno.ENODEV: "{bus} has vanished: its adapter was pulled out, or its kernel driver removed",
    errno.EREMOTEIO: "nothing answers at {address} on {bus}: check power and wires of the "
    "ADS1115, and force_sensor.address",
    errno.EIO: "a transfer on {bus} broke off: check wires and pull-ups, or make the bus slower",
    errno.EBUSY: "a kernel driver owns {address} on {bus}: remove its dtoverlay from the Pi's "
    "config.txt",
    errno.ETIMEDOUT: "{bus} hangs: check SDA and SCL for a short, and the power of the ADS1115",
    errno.EAGAIN: "something else drives {bus}: check SDA and SCL; fishd must be the only master",
}
_ADVICE[errno.ENXIO] = _ADVICE[errno.EREMOTEIO]


def explain(error: Exception, bus: int, address: int) -> str:
    """One line for people about what went wrong with the chip at `address` on /dev/i2c-`bus`.

    An error in other words than Linux's, such as one of a virtual Pi, is left to speak for itself.
    """
    if not isinstance(error, OSError):
        return f"{type(error).__name__}: {error}"
    if error.errno is None:
        return str(error)
    if error.strerror != os.strerror(error.errno):
        return f"{error.strerror} (error {error.errno})"
    advice = _ADVICE.get(error.errno, f"a transfer on {{bus}} failed: {error.strerror}")
    return advice.format(bus=f"/dev/i2c-{bus}", address=f"{address:#04x}") + (
        f" (error {error.errno})"
    )
