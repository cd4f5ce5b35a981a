"""Pins of the Pi's header, through the module RPi.GPIO of either RPi.GPIO or rpi-lgpio."""

import logging
import warnings
from contextlib import suppress
from typing import Any

from fishd.core.errors import StartupError

log = logging.getLogger(__name__)

PACKAGE = "RPi.GPIO"
"""Package that a driver lists in its `packages` if it calls `load`."""
_PROVIDERS = ("RPi.GPIO", "rpi-lgpio")
_EXTRAS = "fishd[rpi-lgpio], or fishd[rpi-gpio] (Pi 4 and older)"


def installed_packages() -> list[str]:
    """Return which of the two packages are installed; exactly one should be."""
    from importlib import metadata  # takes long to load, and only a Pi needs it

    names = []
    for name in _PROVIDERS:
        with suppress(metadata.PackageNotFoundError):
            metadata.distribution(name)
            names.append(name)
    return names


def load() -> Any:
    """Return the module RPi.GPIO, set to Broadcom numbers; raise `StartupError` if that fails.

    Imported only here, because the import fails on any machine that is not a Raspberry Pi.
    """
    if len(installed_packages()) > 1:
        raise StartupError(
            "RPi.GPIO and rpi-lgpio are both installed and overwrite each other: "
            f"uninstall both, then install {_EXTRAS}"
        )
    try:
        from RPi import GPIO
    except ImportError:
        raise StartupError(
            f"the pins of the header need the package RPi.GPIO: install {_EXTRAS}"
        ) from None
    except OSError as error:
        # When imported, lgpio makes a pipe, .lgd-nfyN, in the working folder.
        raise StartupError(
            f"rpi-lgpio cannot make its pipe in the working folder: {error.strerror}; "
            "start fishd in a folder that it may write to"
        ) from None
    except Exception as error:  # RuntimeError, NotImplementedError: not a Pi
        raise StartupError(
            f"the pins of the header cannot be used: {format_error(error)}"
        ) from None
    try:
        GPIO.setmode(GPIO.BCM)
    except Exception as error:  # lgpio.error is a bare Exception
        raise StartupError(
            f"the pins of the header cannot be used: {format_error(error)}; "
            "add the user of fishd to group gpio"
        ) from None
    return GPIO


def claim(gpio_module: Any, gpio: int, direction: int, **options: int) -> None:
    """Set up one pin; raise what the library raises.

    RPi.GPIO warns of a pin that is in use, as after kill -9. The warning is logged and not
    switched off with setwarnings(False): it is the only hint that another program drives the pin.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        gpio_module.setup(gpio, direction, **options)
    for warning in caught:
        log.info("GPIO %d: %s", gpio, warning.message)


def format_error(error: Exception) -> str:
    """Return the text of an error in one line; lgpio puts it in quotes."""
    return " ".join(str(error).strip("'").split()).rstrip(".!") or type(error).__name__
