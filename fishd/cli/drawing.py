"""A full-screen display in the terminal, which restores the terminal at its end."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from fishd.core.process.interruption import defer_signals

if TYPE_CHECKING:
    from rich.live import Live


@contextmanager
def open_full_screen() -> Iterator["Live"]:
    """Yield a display on the alternate screen; restore the previous screen whatever ends this."""
    from rich.live import Live

    live = Live(screen=True, auto_refresh=False)
    try:
        with defer_signals():  # rich does not undo an interrupted start
            live.start()
        yield live
    finally:
        live.stop()
