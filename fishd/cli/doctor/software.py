"""Checks of the software of fishd: Python, packages, configuration file."""

import importlib
import re
import stat
import sys
from importlib import metadata

from fishd.cli.doctor.base import Context, sudo_unless
from fishd.core.errors import MissingPackage, StartupError, install_command
from fishd.hardware import header
from fishd.hardware.checks import Check, Result, fail, ok, on_this_machine, warning
from fishd.hardware.panel_pins import find_chip
from fishd.hardware.registry import PACKAGES

_MODULES = {package: module for module, package in PACKAGES.items()} | {
    "adafruit-blinka": "adafruit_blinka",  # not its module board, which needs pins
    "pyyaml": "yaml",
    "pyzmq": "zmq",
}
"""Module of each package whose module has another name."""
_REQUIREMENT = re.compile(
    r"(?P<name>[\w.-]+)\s*(?P<bounds>[^;]*)(;.*extra == [\"'](?P<extra>.+)[\"'])?"
)
_BOUND = re.compile(r"(>=|<|==)\s*([\d.]+)")


def configuration(context: Context) -> Result:
    """Check whether every user may change the configuration file, which is valid."""
    file = context.file
    if file is None:
        return ok(f"the defaults: robot {context.config.robot}; --config FILE to check a file")
    try:
        status = file.stat()
    except OSError as error:
        return warning(f"{file}: {error.strerror}", "give a file that exists")
    if stat.S_ISREG(status.st_mode) and status.st_mode & stat.S_IWOTH:
        return warning(
            f"{file}: good, but everybody on this machine may change it",
            f"{sudo_unless(status.st_uid)}chmod o-w {file}",
        )
    return ok(f"{file}: good, robot {context.config.robot}")


def packages(context: Context) -> Result:
    """Check the packages that this configuration needs, by the metadata of fishd."""
    kind, requirements, drivers = context.config.kind, [], list[str]()
    texts, packages = list(metadata.requires("fishd") or []), set[str]()
    if kind.has_hardware:
        for driver in context.drivers:
            packages |= {name.lower() for name in driver.find().packages}
            texts += driver.plugins.requirements(driver.name)
            drivers.append(driver.name)
    for text in texts:
        match = _REQUIREMENT.match(text)
        assert match
        name, extra = match["name"].lower(), match["extra"]
        of_driver = extra == "pi" and name in packages
        if extra is None or of_driver or (extra, name) in kind.packages:
            requirements.append((name, match["bounds"]))
    problems = [
        problem for name, bounds in requirements if (problem := _find_problem(name, bounds))
    ]
    if problems:
        return fail("; ".join(problems), install_command(kind.extra))
    user = f"robot {context.config.robot}" + (f" with {' and '.join(drivers)}" if drivers else "")
    return ok(f"all {len(requirements)} that {user} needs, under {sys.executable}")


def gpio_package(context: Context) -> Result | None:
    """Check the packages with which drivers use pins of the header."""
    drivers = [
        driver.name for driver in context.drivers if header.PACKAGE in driver.find().packages
    ]
    installed = header.installed_packages()
    pip = f"{sys.executable} -m pip"
    if len(installed) > 1:
        right = "rpi-lgpio" if "Raspberry Pi 5" in context.model else "the one for this Pi"
        return fail(
            "RPi.GPIO and rpi-lgpio are both installed, and overwrite each other",
            f"{pip} uninstall RPi.GPIO rpi-lgpio; then install {right}",
        )
    if drivers and not installed:
        return fail(
            f"neither RPi.GPIO nor rpi-lgpio is installed, but driver {drivers[0]} needs one",
            f"{install_command('rpi-lgpio')}; or rpi-gpio, on a Pi 4 and older",
        )
    used = installed if drivers else []
    if "RPi.GPIO" in used and "Raspberry Pi 5" in context.model:
        return fail(
            "RPi.GPIO does not work on a Pi 5",
            f"{pip} uninstall RPi.GPIO; {install_command('rpi-lgpio')}",
        )
    return ok(", ".join(used)) if used else None


def gpio_chip(context: Context) -> Result | None:
    """Check that this user may use the GPIO chip that the panel needs."""
    if not context.config.panel.has_pins:
        return None
    try:
        return ok(find_chip())
    except MissingPackage as error:
        return fail(str(error), install_command("pi"))
    except StartupError as error:
        problem, _, remedy = str(error).partition("; ")
        return fail(problem, remedy)


def _find_problem(name: str, bounds: str) -> str | None:
    """Return what is wrong with an installed package; None if nothing is."""
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return f"{name} is not installed"
    for relation, bound in _BOUND.findall(bounds):
        installed, limit = _parse_version(version), _parse_version(bound)
        if (relation == ">=" and installed < limit) or (relation == "<" and installed >= limit):
            return f"{name} is {version}, {relation} {bound} is needed"
    try:
        importlib.import_module(_MODULES.get(name, name))
    except ImportError as error:
        return f"{name} cannot be imported: {error}"
    except Exception as error:
        return f"{name} cannot be imported: {type(error).__name__}: {error}"
    return None


def _parse_version(version: str) -> list[int]:
    return [int(part) for part in re.findall(r"\d+", version)]


CHECKS = (
    Check("configuration", configuration),
    Check("packages", packages),
    Check("gpio package", gpio_package, on_this_machine),
    Check("gpio chip", gpio_chip, on_this_machine),
)
