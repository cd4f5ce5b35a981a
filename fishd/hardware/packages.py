"""Driver libraries are no part of fishd's core: what is said where one of them is missing."""

from collections.abc import Iterator
from contextlib import contextmanager

from fishd.errors import MissingPackage

PACKAGES = {
    "adafruit_ads1x15": "adafruit-circuitpython-ads1x15",
    "adafruit_bus_device": "adafruit-circuitpython-busdevice",
    "adafruit_extended_bus": "adafruit-extended-bus",
    "Adafruit_PureIO": "Adafruit-PureIO",
    "board": "Adafruit-Blinka",
    "busio": "Adafruit-Blinka",
}
"""Where a module has another name than its package."""


@contextmanager
def driver_packages() -> Iterator[None]:
    """Import drivers inside of this; raises `MissingPackage` where a library is not installed."""
    try:
        yield
    except ImportError as error:
        raise MissingPackage(describe(error)) from None


def describe(error: ImportError) -> str:
    """One line that names the package to blame for a failed import."""
    module = (error.name or "").partition(".")[0]
    package = PACKAGES.get(module, module)
    if isinstance(error, ModuleNotFoundError) and package:
        return f"the package {package} is missing; install fishd[pi]"
    return f"the package {package or 'of a driver'} cannot be imported ({error}); install fishd[pi]"
