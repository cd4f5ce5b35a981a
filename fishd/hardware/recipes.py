"""All recipes that one fishd writes, with which other programs end the pulses of its servo."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

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
