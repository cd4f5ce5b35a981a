"""Curves in a terminal: a braille character is a grid of two by four dots."""

from collections.abc import Sequence

import numpy as np

_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])


def curve(
    points: Sequence[tuple[float, float]], start: float, end: float, rows: int, columns: int
) -> list[str]:
    """Draw the line through `points`, as `rows` strings of `columns` characters.

    points: x in rising order, and y from 0 at the bottom to 1 at the top; NaN leaves a gap
    start, end: what x is at the left and at the right edge
    """
    x, y = np.array(points).T
    across = np.linspace(start, end, 2 * columns)
    level = (1.0 - np.interp(across, x, y)) * (4 * rows - 1)
    before = np.concatenate((level[:1], level[:-1]))  # so that a jump is a stroke
    upper, lower = np.rint(np.fmin(level, before)), np.rint(np.fmax(level, before))
    down = np.arange(4 * rows)[:, None]
    dots = ((upper <= down) & (down <= lower)).reshape(rows, 4, columns, 2)
    codes = 0x2800 + np.einsum("rick,ik->rc", dots, _DOTS)
    return ["".join(map(chr, line)) for line in codes]
