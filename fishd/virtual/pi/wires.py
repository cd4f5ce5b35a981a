"""Transfer of the levels of a virtual Pi's pins, for example of a button, to this process."""

import threading
from collections.abc import Callable
from pathlib import Path

from fishd.core.errors import StartupError
from fishd.virtual.pi.link import RemotePi

_RETRY_PERIOD_S = 0.2
"""Time between two attempts to connect to the virtual Pi again [s]."""


class Wires:
    """Copy of the levels of the virtual Pi's pins to the pins of this process."""

    def __init__(self, path: Path, set_level: Callable[[int, int | None], None]) -> None:
        """set_level: sets the level of a GPIO, None where nothing drives the pin.

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
        """Stop the copy; the pins keep their levels. May be called twice."""
        self._closing.set()
        self._remote.close()
        self._thread.join()

    def _follow(self) -> None:
        while not self._closing.is_set():
            try:
                levels = self._remote.await_levels(self._levels)
            except OSError:  # not running, or closing
                self._closing.wait(_RETRY_PERIOD_S)
            else:
                self._adopt(levels)
        self._remote.close()  # a connection that was opened during `close`

    def _adopt(self, levels: dict[int, int]) -> None:
        for gpio in self._levels.keys() | levels.keys():
            if self._levels.get(gpio) != levels.get(gpio):
                self._set_level(gpio, levels.get(gpio))
        self._levels = levels
