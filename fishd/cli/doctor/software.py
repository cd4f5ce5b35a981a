"""Checks of fishd's own software: Python, packages, configuration file."""

import importlib
import re
import stat
import sys
from importlib import metadata

from fishd.cli.doctor.base import Context, sudo_unless
from fishd.hardware import header
from fishd.hardware.checks import Check, Result, fail, ok, warning
from fishd.hardware.registry import PACKAGES

_MODULES = {package: module for module, package in PACKAGES.items()} | {
    "adafruit-blinka": "adafruit_blinka",  # not one of its own, such as board, which looks for pins
    "pyyaml": "yaml",
    "pyzmq": "zmq",
}
"""Where the module has another name than its package."""
_REQUIREMENT = re.compile(
    r"(?P<name>[\w.-]+)\s*(?P<bounds>[^;]*)(;.*extra == [\"'](?P<extra>.+)[\"'])?"
)
_SWIMMER = {("swimmer", "numba"), ("lab", "scipy")}
"""Extra and package of what `robot: swimmer` needs."""
_BOUND = re.compile(r"(>=|<|==)\s*([\d.]+)")


def configuration(context: Context) -> Result:
    """That it is valid is known by now; whether strangers may change it is not."""
    file = context.file
    if file is None:
        return ok(f"the defaults: robot {context.config.robot}; --config FILE to check a file")
    try:
        found = file.stat()
    except OSError as error:
        return warning(f"{file}: {error.strerror}", "give a file that exists")
    if stat.S_ISREG(found.st_mode) and found.st_mode & stat.S_IWOTH:
        return warning(
            f"{file}: good, but everybody on this machine may change it",
            f"{sudo_unless(found.st_uid)}chmod o-w {file}",
        )
    return ok(f"{file}: good, robot {context.config.robot}")


def packages(context: Context) -> Result:
    """Those that this configuration needs, as fishd's own metadata demands them."""
    robot, wanted, drivers = context.robot, [], list[str]()
    texts, packages = list(metadata.requires("fishd") or []), set[str]()
    if context.config.has_hardware:
        for _, plugins, settings in context.drivers:
            packages |= {name.lower() for name in plugins.find(settings.driver).packages}
            texts += plugins.requirements(settings.driver)
            drivers.append(settings.driver)
    for text in texts:
        found = _REQUIREMENT.match(text)
        assert found
        name, extra = found["name"].lower(), found["extra"]
        of_swimmer = robot == "swimmer" and (extra, name) in _SWIMMER
        if extra is None or (extra == "pi" and name in packages) or of_swimmer:
            wanted.append((name, found["bounds"]))
    problems = [problem for name, bounds in wanted if (problem := _problem(name, bounds))]
    if problems:
        extra = {"simulated": "fishd", "swimmer": "fishd[swimmer]"}.get(robot, "fishd[pi]")
        return fail("; ".join(problems), f"{sys.executable} -m pip install '{extra}'")
    who = f"robot {robot} with {' and '.join(drivers)}" if drivers else f"robot {robot}"
    return ok(f"all {len(wanted)} that {who} needs, under {sys.executable}")


def gpio_package(context: Context) -> Result | None:
    """RPi.GPIO and rpi-lgpio overwrite each other."""
    panel = context.config.panel
    pins = {panel.estop_gpio, panel.led_gpio} != {None} or any(
        header.PACKAGE in plugins.find(settings.driver).packages
        for _, plugins, settings in context.drivers
    )
    installed = header.installed()
    pip = f"{sys.executable} -m pip"
    if len(installed) > 1:
        right = "rpi-lgpio" if "Raspberry Pi 5" in context.model else "the one for this Pi"
        return fail(
            "RPi.GPIO and rpi-lgpio are both installed, and overwrite each other",
            f"{pip} uninstall RPi.GPIO rpi-lgpio; then install {right}",
        )
    if not pins:
        return None
    if not installed:
        return fail(
            "neither RPi.GPIO nor rpi-lgpio is installed, but the configuration uses GPIO pins",
            "sudo make install-pi, which says what it takes; without the service "
            f"{pip} install 'fishd[rpi-lgpio]' (Pi 5, Debian 13) or 'fishd[rpi-gpio]'",
        )
    if "RPi.GPIO" in installed and "Raspberry Pi 5" in context.model:
        return fail(
            "RPi.GPIO does not work on a Pi 5",
            f"{pip} uninstall RPi.GPIO; {pip} install 'fishd[rpi-lgpio]'",
        )
    return ok(installed[0])


def _problem(name: str, bounds: str) -> str:
    """What is wrong with an installed package; empty if nothing is."""
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return f"{name} is not installed"
    for relation, bound in _BOUND.findall(bounds):
        mine, limit = _numbers(version), _numbers(bound)
        if (relation == ">=" and mine < limit) or (relation == "<" and mine >= limit):
            return f"{name} is {version}, {relation} {bound} is needed"
    try:
        importlib.import_module(_MODULES.get(name, name))
    except ImportError as error:
        return f"{name} cannot be imported: {error}"
    except Exception as error:
        return f"{name} cannot be imported: {type(error).__name__}: {error}"
    return ""


def _numbers(version: str) -> list[int]:
    return [int(part) for part in re.findall(r"\d+", version)]


CHECKS = (
    Check("configuration", configuration),
    Check("packages", packages),
    Check("gpio package", gpio_package, ("pi",)),
)
