"""The whole terminal to draw on, and how it is given back."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from fishd.core.process.interruption import held_back

if TYPE_CHECKING:
    from rich.live import Live


@contextmanager
def whole_screen() -> Iterator["Live"]:
    """A screen of its own; that of before is shown again, whatever ends or interrupts this."""
    from rich.live import Live

    live = Live(screen=True, auto_refresh=False)
    try:
        with held_back():  # rich does not undo a start that was interrupted half-way
            live.start()
        yield live
    finally:
        live.stop()
