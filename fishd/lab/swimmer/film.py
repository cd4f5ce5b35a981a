"""A film of a free swimmer: an animated WebP or GIF that is painted while it swims."""

import os
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from fishd.core.errors import FishdError, MissingPackage
from fishd.lab.swimmer.view import SIGNED, UNITS, Quantity, View, around, rounded, scale, view
from fishd.lab.swimmer.wake_figure import COLOURS
from fishd.virtual.swimmer.fish import Fish
from fishd.virtual.swimmer.settings import SwimmerSettings

if TYPE_CHECKING:
    from PIL import Image

FORMATS = (".webp", ".gif")
EVERY = 0.02
"""Time between two frames [s], or longer where it is shown the fish less often."""
SLOWER = 2.0
"""A film takes so many times as long as the swim."""
MOST = 800
"""Frames; where there would be more, every other one is left out, and each is shown twice as long,
so that a long run needs no more memory, 0.13 MB a frame."""
COLUMNS = 600
_FOOT = 26
"""Height of the line below the water: time, speed, scales [pixels]."""
_LEVELS, _SHADES = 84, 3
"""So many colours of the water, each also mixed with the body's at its edge: 252 and the body's."""
_INK = (64, 64, 64)
_PAPER = (255, 255, 255)
_FINE = 3
"""The body is painted so much larger first, and so has smooth edges."""
_QUALITY = 60
_WORDS = 12


class Film:
    """Frames of a swimming fish; a context manager, at whose end the file is written.

    It follows the fish; the scales show the laboratory. After an error, too, what was painted is
    written: a fish that was lost can be looked at.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        settings: SwimmerSettings,
        quantity: Quantity = "vorticity",
    ) -> None:
        """Raises as `check` does."""
        check(path)
        self.path = Path(path)
        self._quantity: Quantity = quantity
        self._window = around(settings)
        self._limit = scale(settings, quantity)
        self._frames: list[Image.Image] = []
        self._times: list[float] = []
        self._stride = 1
        self._seen = 0
        self._next = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        try:
            self._write()
        except FishdError:
            if error is None:
                raise

    def look(self, fish: Fish) -> None:
        """Paint a frame where one is due; to be called after each step, or now and then."""
        if fish.time + 1e-9 < self._next:
            return
        self._next = max(self._next + EVERY, fish.time + 0.5 * EVERY)
        if self._seen % self._stride == 0:
            self._frames.append(self._paint(view(fish, self._quantity, self._window, COLUMNS)))
            self._times.append(fish.time)
        self._seen += 1
        if len(self._frames) > MOST:
            self._frames, self._times = self._frames[::2], self._times[::2]
            self._stride *= 2

    def _paint(self, shown: View) -> "Image.Image":
        """A frame: each pixel is a colour of the water, mixed with so much of ink."""
        from PIL import Image

        low = -self._limit if self._quantity in SIGNED else 0.0
        share = (shown.values[::-1] - low) / (self._limit - low)
        water = np.clip(np.rint(share * (_LEVELS - 1)), 0, _LEVELS - 1).astype(np.uint8)
        foot, ink_below = self._foot(shown)
        ink = np.concatenate([self._body(shown, water.shape), ink_below])
        level = np.concatenate([water, foot])
        pixels = np.where(ink < _SHADES, _LEVELS * ink + level, _LEVELS * _SHADES)
        paper = (level == _LEVELS) & (ink < _SHADES)
        pixels[paper] = _LEVELS * _SHADES + 1 + ink[paper]
        frame = Image.fromarray(pixels.astype(np.uint8))
        frame.putpalette(self._palette)
        return frame

    def _body(self, shown: View, shape: tuple[int, ...]) -> NDArray[np.uint8]:
        """How much of each pixel is body, 0 to `_SHADES`."""
        from PIL import Image, ImageDraw

        rows, columns = shape
        mask = Image.new("L", (_FINE * columns, _FINE * rows))
        window = shown.window
        pixels = _FINE * columns / (window.right - window.left)
        x = (shown.outline[:, 0] - window.left) * pixels
        y = (window.top - shown.outline[:, 1]) * pixels
        ImageDraw.Draw(mask).polygon(list(zip(x.tolist(), y.tolist(), strict=True)), fill=255)
        return _shades(mask.reduce(_FINE))

    def _foot(self, shown: View) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The line below: its colours (`_LEVELS` is paper), and its ink."""
        from PIL import Image, ImageDraw

        colours = np.full((_FOOT, COLUMNS), _LEVELS, np.uint8)
        mask = Image.new("L", (COLUMNS, _FOOT))
        draw = ImageDraw.Draw(mask)
        window = shown.window
        width = window.right - window.left
        length = rounded(0.1 * width)
        pixels = round(length / width * COLUMNS)

        def write(x: float, words: str, anchor: str = "lm") -> None:
            draw.text((x, 0.5 * _FOOT), words, fill=255, font=self._font, anchor=anchor)

        write(8, f"{shown.time:.2f} s")
        write(70, f"{1e3 * shown.speed:.0f} mm/s")
        write(150, f"x = {100.0 * shown.x:.1f} cm")
        draw.line([(262, _FOOT // 2), (262 + pixels, _FOOT // 2)], fill=255, width=3)
        write(270 + pixels, f"{100.0 * length:g} cm")
        right = COLUMNS - 8
        unit = UNITS[self._quantity]
        low = f"{-self._limit:g}" if self._quantity in SIGNED else "0"
        write(right, f"{self._limit:g} {unit}", "rm")
        right -= 8 + round(draw.textlength(f"{self._limit:g} {unit}", font=self._font))
        bar = np.linspace(0, _LEVELS - 1, 90).astype(np.uint8)
        colours[7:-7, right - len(bar) : right] = bar
        write(right - len(bar) - 8, f"{self._quantity} {low}", "rm")
        return colours, _shades(mask)

    @cached_property
    def _font(self) -> Any:
        from PIL import ImageFont

        return ImageFont.load_default(_WORDS)

    @cached_property
    def _palette(self) -> list[int]:
        """Water, lightly and heavily mixed with ink; ink; paper, mixed likewise."""
        from matplotlib import colormaps

        shares = np.linspace(0.0, 1.0, _LEVELS)
        water = 255.0 * colormaps[COLOURS[self._quantity]](shares)[:, :3]
        ink, paper = np.array([_INK], float), np.array([_PAPER], float)
        mixes = [(1.0 - k / _SHADES, k / _SHADES) for k in range(_SHADES)]
        parts = [a * water + b * ink for a, b in mixes]
        parts += [ink, *(a * paper + b * ink for a, b in mixes)]
        found = np.rint(np.concatenate(parts)).astype(int)
        return [int(each) for each in found.reshape(-1)]

    def _write(self) -> None:
        if not self._frames:
            return
        first, *others = self._frames
        interval = (self._times[-1] - self._times[0]) / len(others) if others else EVERY
        unit = 1 if self.path.suffix.lower() == ".webp" else 10  # of times in the file [ms]
        options: dict[str, Any] = {
            "save_all": True,
            "append_images": others,
            "duration": unit * round(1e3 * SLOWER * interval / unit),
            "loop": 0,
        }
        if self.path.suffix.lower() == ".webp":
            options |= {"quality": _QUALITY, "method": 4}
        else:
            options |= {"optimize": False}
        try:
            first.save(self.path, **options)
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) and error.strerror else error
            raise FishdError(f"{self.path}: the film cannot be written: {why}") from None


def check(path: str | os.PathLike[str]) -> None:
    """Raise `FishdError` where no film can be written there, before anything swims."""
    for package in ("matplotlib", "PIL"):
        if find_spec(package) is None:
            raise MissingPackage(
                f"a film needs {package}, which is not installed: pip install 'fishd[swimmer]'"
            )
    file = Path(path)
    if file.suffix.lower() not in FORMATS:
        kind = file.suffix or "without a suffix"
        raise FishdError(f"{file}: a film has no format {kind}: {' or '.join(FORMATS)} is needed")
    if not file.parent.is_dir():
        raise FishdError(f"{file}: the film cannot be written: there is no folder {file.parent}")


def _shades(mask: "Image.Image") -> NDArray[np.uint8]:
    return np.rint(np.asarray(mask) / 255.0 * _SHADES).astype(np.uint8)
