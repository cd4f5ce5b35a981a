"""Program that draws on a terminal, interrupted when it enters the screen."""

from pathlib import Path

ENTER_SCREEN, LEAVE_SCREEN = "\x1b[?1049h", "\x1b[?1049l"
"""Sequences that enter and leave the alternate screen."""
_SOURCE = """
import signal
from rich.console import Console

take = Console.set_alt_screen

def take_and_be_interrupted(console, enable=True):
    changed = take(console, enable)
    if enable:
        signal.raise_signal(signal.{name})
    return changed

Console.set_alt_screen = take_and_be_interrupted
"""


def signal_as_drawing_begins(folder: Path, name: str) -> dict[str, str]:
    """Return the environment of a Python that gets this signal just after it enters the screen."""
    (folder / "sitecustomize.py").write_text(_SOURCE.format(name=name))
    return {"PYTHONPATH": str(folder)}
