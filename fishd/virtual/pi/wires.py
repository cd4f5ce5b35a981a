"""Carries what is wired to the pins of a virtual Pi, such as a button, into another process."""

import threading
from collections.abc import Callable
from pathlib import Path

from fishd.core.errors import StartupError
from fishd.virtual.pi.link import RemotePi

_PAUSE = 0.2
"""Between attempts to find the virtual Pi again [s]."""


class Wires:
    """Keeps the levels of the pins of this process as they are at the virtual Pi."""

    def __init__(self, path: Path, set_level: Callable[[int, int | None], None]) -> None:
        """set_level: takes GPIO and level, None where nothing drives the pin any more.

        Raises `StartupError` when no virtual Pi listens at `path`, or it does not answer.
        """
        self._remote = RemotePi(path)
        self._set_level = set_level
        self._closing = threading.Event()
        self._levels: dict[int, int] = {}
        try:
            self._adopt(self._remote.state().levels)
        except OSError as error:
            self._remote.close()
            raise StartupError(error.strerror) from None
        self._thread = threading.Thread(target=self._follow, name="wires", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the pins as they are; may be called twice."""
        self._closing.set()
        self._remote.close()
        self._thread.join()

    def _follow(self) -> None:
        while not self._closing.is_set():
            try:
                levels = self._remote.await_levels(self._levels)
            except OSError:  # gone, or closing
                self._closing.wait(_PAUSE)
            else:
                self._adopt(levels)
        self._remote.close()  # a connection made while closing

    def _adopt(self, levels: dict[int, int]) -> None:
        for gpio in self._levels.keys() | levels.keys():
            if self._levels.get(gpio) != levels.get(gpio):
                self._set_level(gpio, levels.get(gpio))
        self._levels = levels
