"""What every eye does: it is fitted to the babble once, then sees stack after stack."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fishd.core.camera_frames import Pixels, Stack, StackSettings

Array = NDArray[np.float32]


Nodes = tuple[list[Any], dict[str, NDArray[Any]]]
"""Operators of ONNX in the order in which they run, and their constants by name."""


class Eye(ABC):
    """Turns a stack of frames into numbers, by constants that learning does not change.

    They are found once, from the babble: frames of a tail that is driven at random. A policy file
    carries them in its network.
    """

    shape: tuple[int, int, int] | None = None
    """Channels, height and width of what it gives, where that is a picture whose mirror image is
    that of the mirrored fish; None for numbers that change sign instead."""
    outputs: int
    """How many numbers it gives."""
    network: Literal["cnn", "nature"] = "cnn"
    """Which network looks at that picture."""
    shapes: Mapping[str, tuple[int, ...]]
    """Of its constants, by name."""

    def __init__(self, stack: StackSettings) -> None:
        self.stack = stack
        self.constants: dict[str, Array] = {}
        """What the babble taught it, by name; empty until it is fitted."""
        self._latest: deque[tuple[Pixels, Array]] = deque(maxlen=2 * stack.frames)
        """Frames that were seen, and what came of each: most are in several stacks."""

    @abstractmethod
    def fit(self, frames: Pixels, angles: NDArray[np.float64]) -> None:
        """Find the constants.

        frames: the newest of each tick of the babble, shape (ticks, size, size)
        angles: instruction angle that was applied until each of these ticks, shape (ticks,) [rad]

        Raises `fishd.camera.axis.NoMotion` where the tail is not to be seen.
        """

    def see(self, stack: Stack) -> Array:
        """What it gives, shape (outputs,)."""
        return self.joined([self._seen(frame) for frame in stack]).ravel()

    @abstractmethod
    def glimpse(self, frame: Pixels) -> Array:
        """What is made of a single frame, shape (size, size)."""

    @abstractmethod
    def joined(self, glimpses: list[Array]) -> Array:
        """What it gives for a stack, from what was made of each of its frames."""

    def _seen(self, frame: Pixels) -> Array:
        for known, glimpse in self._latest:
            if known is frame:
                return glimpse
        glimpse = self.glimpse(frame)
        self._latest.append((frame, glimpse))
        return glimpse

    @abstractmethod
    def nodes(self, pictures: str, out: str) -> Nodes:
        """The same as operators of ONNX, and their constants.

        pictures: name of the stack, float32 of shape (1, frames, size, size)
        out: name of the result, shape (1, outputs), or (1, *shape) for a picture
        """

    @property
    def is_fitted(self) -> bool:
        """Has it seen a babble, if it needs one?"""
        return set(self.constants) == set(self.shapes)

    def restore(self, constants: Mapping[str, Array]) -> None:
        """Take over constants that were kept; raises ValueError where they are not those."""
        found = {name: array.shape for name, array in constants.items()}
        if found != self.shapes:
            raise ValueError(f"constants of shapes {found}; {dict(self.shapes)} are needed")
        if not all(np.isfinite(array).all() for array in constants.values()):
            raise ValueError("constants that are not finite numbers")
        self.constants = dict(constants)


def lit(pictures: NDArray[Any]) -> Array:
    """Frames over their mean grey level, which takes off how bright the light is."""
    size = pictures.shape[-1] * pictures.shape[-2]
    sums = pictures.sum(axis=(-2, -1), dtype=np.uint32, keepdims=True)
    found: Array = pictures * (np.float32(size) / np.maximum(sums, size).astype(np.float32))
    return found


def lit_nodes(pictures: str, out: str, size: int) -> Nodes:
    """`lit` as operators of ONNX, on float32 of shape (1, frames, size, size)."""
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
