"""The base class of eyes: an eye is fitted to the babble once, then converts stacks of frames."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fishd.core.camera_frames import Pixels, Stack, StackSettings

Array = NDArray[np.float32]


Nodes = tuple[list[Any], dict[str, NDArray[Any]]]
"""Operators of ONNX in their order of execution, and their constants by name."""


class Eye(ABC):
    """A conversion of stacks of frames to numbers, with constants that learning does not change.

    The constants are fitted once, to the babble: frames of a tail that is driven at random. The
    network of a policy file contains them.
    """

    shape: tuple[int, int, int] | None = None
    """Channels, height and width of the output, if that is a picture whose mirror image is that of
    a mirrored fish; None for numbers that change sign instead."""
    outputs: int
    """Number of outputs."""
    network: Literal["cnn", "nature"] = "cnn"
    """Network that receives the output picture."""
    shapes: Mapping[str, tuple[int, ...]]
    """Shapes of the constants, by name."""

    def __init__(self, stack: StackSettings) -> None:
        self.stack = stack
        self.constants: dict[str, Array] = {}
        """Constants by name; empty until the eye is fitted."""
        self._latest: deque[tuple[Pixels, Array]] = deque(maxlen=2 * stack.frames)
        """Latest frames with their codes, a cache, since a frame is in several stacks."""

    @abstractmethod
    def fit(self, frames: Pixels, angles: NDArray[np.float64]) -> None:
        """Fit the constants.

        frames: newest frame of each tick of the babble, shape (ticks, size, size)
        angles: instruction angle applied until each of these ticks, shape (ticks,) [rad]

        Raises `fishd.camera.axis.NoMotion` where the tail is not visible.
        """

    def see(self, stack: Stack) -> Array:
        """Return the outputs for a stack, shape (outputs,)."""
        return self.combine([self._encode_cached(frame) for frame in stack]).ravel()

    @abstractmethod
    def encode_frame(self, frame: Pixels) -> Array:
        """Return the code of a single frame; frame: shape (size, size)."""

    @abstractmethod
    def combine(self, codes: list[Array]) -> Array:
        """Return the outputs for a stack from the codes of its frames."""

    def _encode_cached(self, frame: Pixels) -> Array:
        for known, code in self._latest:
            if known is frame:
                return code
        code = self.encode_frame(frame)
        self._latest.append((frame, code))
        return code

    @abstractmethod
    def nodes(self, pictures: str, out: str) -> Nodes:
        """Return `see` as operators of ONNX, and their constants.

        pictures: name of the stack, float32 of shape (1, frames, size, size)
        out: name of the result, shape (1, outputs), or (1, *shape) for a picture
        """

    @property
    def is_fitted(self) -> bool:
        """Whether the eye has all its constants."""
        return set(self.constants) == set(self.shapes)

    def restore(self, constants: Mapping[str, Array]) -> None:
        """Set the constants from a file; raises ValueError where their names or shapes differ."""
        shapes = {name: array.shape for name, array in constants.items()}
        if shapes != self.shapes:
            raise ValueError(f"constants of shapes {shapes}; {dict(self.shapes)} are needed")
        if not all(np.isfinite(array).all() for array in constants.values()):
            raise ValueError("constants that are not finite numbers")
        self.constants = dict(constants)


def normalise(pictures: NDArray[Any]) -> Array:
    """Return frames divided by their mean grey level, which removes the brightness of the light."""
    size = pictures.shape[-1] * pictures.shape[-2]
    sums = pictures.sum(axis=(-2, -1), dtype=np.uint32, keepdims=True)
    normalised: Array = pictures * (np.float32(size) / np.maximum(sums, size).astype(np.float32))
    return normalised


def normalise_nodes(pictures: str, out: str, size: int) -> Nodes:
    """Return `normalise` as operators of ONNX, on float32 of shape (1, frames, size, size)."""
    from onnx import helper

    sums, bright, factor, area, plane = (
        f"{out}_{name}" for name in ("sums", "bright", "factor", "area", "plane")
    )
    nodes = [
        helper.make_node("ReduceSum", [pictures, plane], [sums]),
        helper.make_node("Max", [sums, area], [bright]),
        helper.make_node("Div", [area, bright], [factor]),
        helper.make_node("Mul", [pictures, factor], [out]),
    ]
    return nodes, {area: np.array(size * size, np.float32), plane: np.array([2, 3])}
