"""The eyes that leave seeing to a network: `cnn` prepares the picture, `nature` does not."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fishd.camera.axis import find_motion
from fishd.core.camera_frames import Pixels, StackSettings
from fishd.learning.eyes.base import Array, Eye, Nodes, lit, lit_nodes

SHRINK = 4
"""The eye `cnn` averages over squares of so many pixels' side."""


class CnnEye(Eye):
    """The newest frame and the differences between frames, shrunk, about the axis."""

    def __init__(self, stack: StackSettings, align: bool) -> None:
        super().__init__(stack)
        self._align = align
        small = stack.size // SHRINK
        self.shape = (stack.frames, small, small)
        self.outputs = stack.frames * small * small
        self.shapes = {
            "rows": (small, stack.size),
            "columns": (stack.size, small),
            "mean": (small, small),
            "scale": (1,),
        }

    def fit(self, frames: Pixels, angles: NDArray[np.float64]) -> None:
        """Find axis, mean picture and contrast; see the base class."""
        size = self.stack.size
        shift = 0.0
        if self._align:
            motion = find_motion(frames)
            column = round(motion.centre)
            shift = float(motion.axis.rows(size, size)[column]) - 0.5 * (size - 1)
        rows, columns = _shrinking(size, shift), _shrinking(size, 0.0).T.copy()
        shrunk = np.stack([rows @ frame @ columns for frame in lit(frames)])
        mean = shrunk.mean(axis=0)
        self.constants = {
            "rows": rows,
            "columns": columns,
            "mean": mean.astype(np.float32),
            "scale": np.array([1.0 / (shrunk - mean).std()], np.float32),
        }

    def glimpse(self, frame: Pixels) -> Array:
        """Deviation from the mean picture, over its deviation in the babble."""
        found = self.constants
        small = found["rows"] @ lit(frame) @ found["columns"]
        return np.asarray((small - found["mean"]) * found["scale"], np.float32)

    def joined(self, glimpses: list[Array]) -> Array:
        """The newest, then the differences to older ones."""
        newest, *_ = glimpses
        pairs = pairwise(glimpses)
        return np.stack([newest, *(newer - older for newer, older in pairs)])

    def nodes(self, pictures: str, out: str) -> Nodes:
        """See the base class."""
        from onnx import helper

        nodes, constants = lit_nodes(pictures, "lit", self.stack.size)
        last = self.stack.frames - 1
        constants |= {**self.constants, "channel": np.array([1])}
        constants |= {f"at_{k}": np.array([k]) for k in {0, 1, last, last + 1}}
        nodes += [
            helper.make_node("MatMul", ["rows", "lit"], ["wide"]),
            helper.make_node("MatMul", ["wide", "columns"], ["small"]),
            helper.make_node("Sub", ["small", "mean"], ["deviation"]),
            helper.make_node("Mul", ["deviation", "scale"], ["glimpses" if last else out]),
        ]
        if last:  # the newest, then each less the one after it
            end = f"at_{last + 1}"
            nodes += [
                helper.make_node("Slice", ["glimpses", "at_0", "at_1", "channel"], ["newest"]),
                helper.make_node("Slice", ["glimpses", "at_0", f"at_{last}", "channel"], ["newer"]),
                helper.make_node("Slice", ["glimpses", "at_1", end, "channel"], ["older"]),
                helper.make_node("Sub", ["newer", "older"], ["differences"]),
                helper.make_node("Concat", ["newest", "differences"], [out], axis=1),
            ]
        return nodes, constants


class NatureEye(Eye):
    """The frames as they are, from 0 to 1, as in the paper."""

    network = "nature"

    def __init__(self, stack: StackSettings) -> None:
        super().__init__(stack)
        self.shape = (stack.frames, stack.size, stack.size)
        self.outputs = stack.frames * stack.size**2
        self.shapes = {}

    def fit(self, frames: Pixels, angles: NDArray[np.float64]) -> None:
        """There is nothing to find."""

    def glimpse(self, frame: Pixels) -> Array:
        """Grey levels over 255."""
        return frame.astype(np.float32) * np.float32(1.0 / 255.0)

    def joined(self, glimpses: list[Array]) -> Array:
        """See the base class."""
        return np.stack(glimpses)

    def nodes(self, pictures: str, out: str) -> Nodes:
        """See the base class."""
        from onnx import helper

        node = helper.make_node("Mul", [pictures, "white"], [out])
        return [node], {"white": np.array(1.0 / 255.0, np.float32)}


def _shrinking(size: int, shift: float) -> Array:
    """Weights, shape (size // SHRINK, size), that average rows about a shifted middle.

    shift: of the middle [px]; rows beyond the picture are those of its edge
    """
    small = size // SHRINK
    weights = np.zeros((small, size), np.float32)
    for row in range(small * SHRINK):
        place = row + shift + 0.5 * (size - SHRINK * small)
        below = int(np.floor(place))
        share = place - below
        weights[row // SHRINK, min(max(below, 0), size - 1)] += (1.0 - share) / SHRINK
        weights[row // SHRINK, min(max(below + 1, 0), size - 1)] += share / SHRINK
    return weights
