"""The eyes that pass pictures to a network: `cnn` preprocesses them, `nature` does not."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fishd.camera.axis import find_motion
from fishd.core.camera_frames import Pixels, StackSettings
from fishd.learning.eyes.base import Array, Eye, Nodes, normalise, normalise_nodes

SHRINK = 4
"""Side of the squares of pixels that the eye `cnn` averages over [px]."""


class CnnEye(Eye):
    """An eye that returns the newest frame and differences of frames, shrunk, about the axis."""

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
        """Fit axis, mean picture and contrast; see the base class."""
        size = self.stack.size
        shift = 0.0
        if self._align:
            motion = find_motion(frames)
            column = round(motion.centre)
            shift = float(motion.axis.rows(size, size)[column]) - 0.5 * (size - 1)
        rows, columns = _shrink_matrix(size, shift), _shrink_matrix(size, 0.0).T.copy()
        shrunk = np.stack([rows @ frame @ columns for frame in normalise(frames)])
        mean = shrunk.mean(axis=0)
        self.constants = {
            "rows": rows,
            "columns": columns,
            "mean": mean.astype(np.float32),
            "scale": np.array([1.0 / (shrunk - mean).std()], np.float32),
        }

    def encode_frame(self, frame: Pixels) -> Array:
        """Return the difference to the mean picture, over its standard deviation in the babble."""
        constants = self.constants
        small = constants["rows"] @ normalise(frame) @ constants["columns"]
        return np.asarray((small - constants["mean"]) * constants["scale"], np.float32)

    def combine(self, codes: list[Array]) -> Array:
        """Return the newest code, then the differences between successive ones."""
        newest, *_ = codes
        pairs = pairwise(codes)
        return np.stack([newest, *(newer - older for newer, older in pairs)])

    def nodes(self, pictures: str, out: str) -> Nodes:
        """Return `see` as operators of ONNX; see the base class."""
        from onnx import helper

        nodes, constants = normalise_nodes(pictures, "lit", self.stack.size)
        last = self.stack.frames - 1
        constants |= {**self.constants, "channel": np.array([1])}
        constants |= {f"at_{k}": np.array([k]) for k in {0, 1, last, last + 1}}
        nodes += [
            helper.make_node("MatMul", ["rows", "lit"], ["wide"]),
            helper.make_node("MatMul", ["wide", "columns"], ["small"]),
            helper.make_node("Sub", ["small", "mean"], ["deviation"]),
            helper.make_node("Mul", ["deviation", "scale"], ["glimpses" if last else out]),
        ]
        if last:  # the newest, then the differences between successive codes
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
    """An eye that returns the frames unchanged, scaled to 0 to 1, as in the paper."""

    network = "nature"

    def __init__(self, stack: StackSettings) -> None:
        super().__init__(stack)
        self.shape = (stack.frames, stack.size, stack.size)
        self.outputs = stack.frames * stack.size**2
        self.shapes = {}

    def fit(self, frames: Pixels, angles: NDArray[np.float64]) -> None:
        """Do nothing: this eye has no constants."""

    def encode_frame(self, frame: Pixels) -> Array:
        """Return the grey levels divided by 255."""
        return frame.astype(np.float32) * np.float32(1.0 / 255.0)

    def combine(self, codes: list[Array]) -> Array:
        """Return the codes as channels."""
        return np.stack(codes)

    def nodes(self, pictures: str, out: str) -> Nodes:
        """Return `see` as operators of ONNX; see the base class."""
        from onnx import helper

        node = helper.make_node("Mul", [pictures, "white"], [out])
        return [node], {"white": np.array(1.0 / 255.0, np.float32)}


def _shrink_matrix(size: int, shift: float) -> Array:
    """Return weights that average rows about a shifted middle, shape (size // SHRINK, size).

    shift: shift of the middle [px]; the row at the edge stands for rows beyond it
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
