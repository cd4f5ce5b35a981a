"""All recipes that one fishd writes, with which other programs end the pulses of its servo."""

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from fishd.core.local_daemons import LocalDaemon, hash_address
from fishd.core.process.runtime_folder import runtime_folder
from fishd.hardware import release_recipe
from fishd.hardware.driver import LastResort


class Recipes:
    """Recipes of one fishd, each a file of `release_recipe`."""

    def __init__(self, file: Path | None, control: Path | None) -> None:
        """
        file: configuration file, with which `fishd-release` finds its recipe
        control: control socket, with which `fishctl estop` finds its recipe
        """
        self._file = file
        self._controls = [control] if control else []
        self._write: Callable[[str], None] = lambda name: None

    def write(self, resort: LastResort, neutral: float) -> None:
        """Write all recipes; neutral: pulse width [µs]."""
        self._write = partial(
            release_recipe.write,
            function=resort.function,
            neutral=neutral,
            arguments=resort.arguments,
        )
        self._write_all()

    def write_without_servo(self) -> None:
        """Write recipes that say that this fishd has no servo, for the control socket alone."""
        self._file = None
        self._write = release_recipe.write_without_servo
        self._write_all()

    def write_for(self, control: Path) -> None:
        """Write all recipes again, because their folder was gone; `control` is the socket now."""
        if control not in self._controls:
            self._controls.append(control)
        self._write_all()

    def remove_former(self) -> None:
        """Remove the recipes of an earlier fishd."""
        for name in self._names():
            release_recipe.remove(name)

    def remove_at_end(self, _: object, error: BaseException | None, __: object) -> None:
        """Remove the recipes for the control socket, unless there may be pulses."""
        if error is None:
            for control in self._controls:
                release_recipe.remove(str(control))

    def _write_all(self) -> None:
        for name in self._names():
            self._write(name)

    def _names(self) -> list[str]:
        return [str(path) for path in (self._file, *self._controls) if path]


def find_recipe(daemon: LocalDaemon) -> dict[str, Any] | None:
    """Return the recipe of a fishd of this user for its control socket; None if there is none.

    It lies in a folder that the environment of the fishd names, which that of this process may not.
    """
    environment = _read_environment(daemon.pid) or {
        "XDG_RUNTIME_DIR": f"/run/user/{daemon.user}"  # most likely
    }
    for folder in dict.fromkeys((runtime_folder(environment), runtime_folder({}))):
        for recipe in release_recipe.read_all(folder):
            if hash_address(f"ipc://{recipe['config']}") == daemon.hash:
                return recipe
    return None


def _read_environment(pid: int) -> dict[str, str]:
    """Return the environment with which a process was started; empty if it cannot be read."""
    try:
        variables = Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
    except OSError:
        return {}
    pairs = (os.fsdecode(variable).partition("=") for variable in variables)
    return {name: value for name, _, value in pairs}
