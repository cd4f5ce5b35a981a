"""Pictures in a terminal: two pixels a character, or shades of grey without colours."""

import numpy as np
from rich.color import Color
from rich.console import Console, ConsoleOptions, RenderResult
from rich.segment import Segment
from rich.style import Style

from fishd.camera.drawing import Colours
from fishd.camera.picture import resize

_SHADES = " ░▒▓█"
_COLOUR_STEP = 8
"""Levels that count as one colour, so that few escape sequences are written."""


class TerminalPicture:
    """Picture that is scaled to the space available."""

    def __init__(self, colours: Colours) -> None:
        self._colours = colours

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Yield lines of characters, each one pixel wide and two high."""
        height, width = self._colours.shape[:2]
        max_rows = 2 * max(1, (options.height or console.height) - 4)
        scale = min(1.0, options.max_width / width, max_rows / height)
        columns, rows = max(1, int(width * scale)), max(2, int(height * scale) // 2 * 2)
        scaled_picture = resize(self._colours, columns, rows)
        is_grey = console.color_system is None or console.no_color
        for upper, lower in zip(scaled_picture[::2], scaled_picture[1::2], strict=True):
            yield from _draw_shades(upper, lower) if is_grey else _draw_blocks(upper, lower)
            yield Segment.line()


def _draw_blocks(upper: Colours, lower: Colours) -> RenderResult:
    """Yield half blocks: the upper pixel as foreground colour, the lower one as background."""
    pairs = np.concatenate([upper, lower], axis=1) // _COLOUR_STEP * _COLOUR_STEP
    begin = 0
    changes = np.flatnonzero((pairs[1:] != pairs[:-1]).any(axis=1)) + 1
    for end in [*changes.tolist(), len(pairs)]:
        red, green, blue, red_below, green_below, blue_below = pairs[begin].tolist()
        style = Style(
            color=Color.from_rgb(red, green, blue),
            bgcolor=Color.from_rgb(red_below, green_below, blue_below),
        )
        yield Segment("▀" * (end - begin), style)
        begin = end


def _draw_shades(upper: Colours, lower: Colours) -> RenderResult:
    levels = (upper.astype(np.uint16) + lower).mean(axis=1) / 2.0
    yield Segment("".join(_SHADES[int(level * len(_SHADES) / 256.0)] for level in levels))
