"""Film of a free swimmer: an animated WebP or GIF, painted while the fish swims."""

import os
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from fishd.core.errors import FishdError, MissingPackage
from fishd.lab.drawing import load_matplotlib
from fishd.lab.swimmer.wake import (
    COLOURS,
    View,
    choose_colour_limit,
    round_number,
    take_view,
    window_around,
)
from fishd.virtual.swimmer.fish import Fish
from fishd.virtual.swimmer.settings import SwimmerSettings

if TYPE_CHECKING:
    from PIL import Image

FORMATS = (".webp", ".gif")
FRAME_INTERVAL_S = 0.02
"""Shortest time between two frames [s]."""
SLOW_MOTION = 2.0
"""Duration of the film divided by the duration of the swim."""
MAX_FRAMES = 800
"""Largest number of frames; beyond it every other frame is dropped and the interval doubles.

This bounds the memory of a long run: a frame needs 0.13 MB.
"""
COLUMNS = 600
_FOOTER_HEIGHT = 26
"""Height of the line of text below the water [pixels]."""
_INK = (64, 64, 64)
_PAPER = (255, 255, 255)
_OVERSAMPLING = 3
"""Factor by which the body is painted larger first, for smooth edges."""
_QUALITY = 60
_FONT_SIZE = 12
_BAR_LENGTH, _BAR_HEIGHT = 90, 12
"""Size of the bar of colours [pixels]."""


class Film:
    """Film of a swimming fish; a context manager that writes the file at its end.

    The window follows the fish; coordinates are those of the laboratory. The file is also written
    after an error, so that it shows the fish until then.
    """

    def __init__(self, path: str | os.PathLike[str], settings: SwimmerSettings) -> None:
        """Raises as `check` does."""
        check(path)
        self.path = Path(path)
        self._window = window_around(settings)
        self._limit = choose_colour_limit(settings)
        self._frames: list[Image.Image] = []
        self._times: list[float] = []
        self._stride = 1
        self._frame_count = 0
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

    def add_frame(self, fish: Fish) -> None:
        """Paint a frame if one is due; to be called after each step, or less often."""
        if fish.time + 1e-9 < self._next:
            return
        self._next = max(self._next + FRAME_INTERVAL_S, fish.time + 0.5 * FRAME_INTERVAL_S)
        if self._frame_count % self._stride == 0:
            self._frames.append(self._paint(take_view(fish, self._window, COLUMNS)))
            self._times.append(fish.time)
        self._frame_count += 1
        if len(self._frames) > MAX_FRAMES:
            self._frames, self._times = self._frames[::2], self._times[::2]
            self._stride *= 2

    def _paint(self, scene: View) -> "Image.Image":
        """Return a frame: the water, the body in it, and a line of text below."""
        from PIL import Image, ImageDraw

        water = self._colour(scene.vorticity[::-1])
        rows, columns, _ = water.shape
        frame = Image.new("RGB", (columns, rows + _FOOTER_HEIGHT), _PAPER)
        frame.paste(Image.fromarray(water))
        mask = Image.new("L", (_OVERSAMPLING * columns, _OVERSAMPLING * rows))
        window = scene.window
        pixels = _OVERSAMPLING * columns / (window.right - window.left)
        x = (scene.outline[:, 0] - window.left) * pixels
        y = (window.top - scene.outline[:, 1]) * pixels
        ImageDraw.Draw(mask).polygon(list(zip(x.tolist(), y.tolist(), strict=True)), fill=255)
        frame.paste(_INK, mask=mask.reduce(_OVERSAMPLING))
        self._draw_footer(frame, scene, rows + _FOOTER_HEIGHT // 2)
        return frame.quantize()  # a third of the memory

    def _colour(self, values: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Return the colours of values, shape (rows, columns, 3)."""
        load_matplotlib()
        from matplotlib import colormaps

        share = 0.5 + 0.5 * values / self._limit
        colours: NDArray[np.uint8] = colormaps[COLOURS](share, bytes=True)[..., :3]
        return colours

    def _draw_footer(self, frame: "Image.Image", scene: View, middle: int) -> None:
        """Draw time, speed, place, a scale, and the colours of the water; middle: row [pixels]."""
        from PIL import Image, ImageDraw

        draw = ImageDraw.Draw(frame)
        width = scene.window.right - scene.window.left
        length = round_number(0.1 * width)
        pixels = round(length / width * COLUMNS)

        def write(x: float, content: str, anchor: str = "lm") -> None:
            draw.text((x, middle), content, fill=_INK, font=self._font, anchor=anchor)

        write(8, f"{scene.time:.2f} s")
        write(70, f"{1e3 * scene.speed:.0f} mm/s")
        write(150, f"x = {100.0 * scene.x:.1f} cm")
        draw.line([(262, middle), (262 + pixels, middle)], fill=_INK, width=3)
        write(270 + pixels, f"{100.0 * length:g} cm")
        right, limit = COLUMNS - 8, f"{self._limit:g} 1/s"
        write(right, limit, "rm")
        right -= 8 + round(draw.textlength(limit, font=self._font)) + _BAR_LENGTH
        bar = np.linspace(-self._limit, self._limit, _BAR_LENGTH)[None].repeat(_BAR_HEIGHT, axis=0)
        frame.paste(Image.fromarray(self._colour(bar)), (right, middle - _BAR_HEIGHT // 2))
        write(right - 8, f"vorticity {-self._limit:g}", "rm")

    @cached_property
    def _font(self) -> Any:
        from PIL import ImageFont

        return ImageFont.load_default(_FONT_SIZE)

    def _write(self) -> None:
        if not self._frames:
            return
        first, *rest = self._frames
        interval = (self._times[-1] - self._times[0]) / len(rest) if rest else FRAME_INTERVAL_S
        unit = 1 if self.path.suffix.lower() == ".webp" else 10  # of times in the file [ms]
        options: dict[str, Any] = {
            "save_all": True,
            "append_images": rest,
            "duration": unit * round(1e3 * SLOW_MOTION * interval / unit),
            "loop": 0,
        }
        if self.path.suffix.lower() == ".webp":
            options |= {"quality": _QUALITY, "method": 4}
        else:
            options |= {"optimize": False}
        try:
            first.save(self.path, **options)
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) and error.strerror else error
            raise FishdError(f"{self.path}: the film cannot be written: {reason}") from None


def check(path: str | os.PathLike[str]) -> None:
    """Raise `FishdError` if a film cannot be written to this path; call before the swim."""
    for package in ("matplotlib", "PIL"):
        if find_spec(package) is None:
            raise MissingPackage.of_extra("a film", package, "swimmer")
    file = Path(path)
    if file.suffix.lower() not in FORMATS:
        kind = file.suffix or "without a suffix"
        raise FishdError(f"{file}: a film has no format {kind}: {' or '.join(FORMATS)} is needed")
    if not file.parent.is_dir():
        raise FishdError(
            f"{file}: the film cannot be written: the folder {file.parent} does not exist"
        )
