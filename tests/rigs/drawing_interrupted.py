"""A program that draws on a terminal, interrupted at the moment when it takes the screen."""

from pathlib import Path

ENTER_SCREEN, LEAVE_SCREEN = "\x1b[?1049h", "\x1b[?1049l"
"""What changes to a screen of its own, and back."""
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
    """The environment of a Python that gets this signal just after its screen was taken."""
    (folder / "sitecustomize.py").write_text(_SOURCE.format(name=name))
    return {"PYTHONPATH": str(folder)}
