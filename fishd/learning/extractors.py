"""The feature extractors: one is fitted once, then converts stacks of frames to numbers.

`modes` works like a lock-in amplifier: each pixel of the part of the picture that changes sign in
the mirror is regressed on the latest commands, and the strongest patterns of the explained part are
kept. Light, noise and ripples of the water do not follow the command, so they are suppressed.
`cnn` and `nature` pass pictures to a network; `cnn` preprocesses them.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fishd.camera.axis import Axis, find_motion
from fishd.core.camera_frames import Pixels, Stack, StackSettings
from fishd.learning.settings import TrainingSettings

Array = NDArray[np.float32]
Nodes = tuple[list[Any], dict[str, NDArray[Any]]]
"""Operators of ONNX in their order of execution, and their constants by name."""
SHRINK = 4
"""Side of the squares of pixels that the feature extractor `cnn` averages over [px]."""
_MAX_HOLD_TICKS = 6
"""Largest number of ticks for which an angle of the random excitation is held."""


class FeatureExtractor(ABC):
    """A conversion of stacks of frames to numbers, with constants that learning does not change.

    The constants are fitted once, to the random excitation: frames of a tail that is driven at
    random. The network of a policy file contains them.
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
        """Constants by name; empty until the feature extractor is fitted."""
        self._latest: deque[tuple[Pixels, Array]] = deque(maxlen=2 * stack.frames)
        """Latest frames with their codes, a cache, since a frame is in several stacks."""

    @abstractmethod
    def fit(self, frames: Pixels, angles: NDArray[np.float64]) -> None:
        """Fit the constants.

        frames: newest frame of each tick of the random excitation, shape (ticks, size, size)
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
        """Whether the feature extractor has all its constants."""
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


class ModesExtractor(FeatureExtractor):
    """Extractor of the amplitudes of a few patterns in each frame, newest frame first."""

    def __init__(self, stack: StackSettings, modes: int, memory: int, align: bool) -> None:
        """
        modes: number of patterns
        memory: number of commands that a frame is regressed on
        align: whether to detect the axis; else it is the middle row
        """
        super().__init__(stack)
        self._modes, self._memory, self._align = modes, memory, align
        self.outputs = stack.frames * modes
        self.shapes = {"patterns": (modes, stack.size**2), "zero": (modes,)}

    def fit(self, frames: Pixels, angles: NDArray[np.float64]) -> None:
        """Fit the patterns; see the base class."""
        axis = find_motion(frames).axis if self._align else Axis(offset=0.0)
        values = normalise(frames)
        mean = values.mean(axis=0)
        odd = _odd_part(values - mean, axis).reshape(len(frames), -1)[self._memory :]
        lags = np.stack(
            [
                angles[self._memory - lag : len(angles) - lag]  # angles[i]: applied until tick i
                for lag in range(self._memory)
            ],
            axis=1,
        )
        commands = np.linalg.qr(lags - lags.mean(axis=0))[0]
        explained = commands.T @ odd
        patterns = np.linalg.svd(explained, full_matrices=False)[2][: self._modes]
        follow = (odd @ patterns.T).T @ lags.mean(axis=1)  # with the sign of the command,
        patterns *= np.where(follow < 0.0, -1.0, 1.0)[
            :, None
        ]  # so that another feature extractor has the same signs
        patterns /= (odd @ patterns[0]).std()
        self.constants = {
            "patterns": patterns.astype(np.float32),
            "zero": (patterns @ mean.ravel()).astype(np.float32),
        }

    def encode_frame(self, frame: Pixels) -> Array:
        """Return the amplitudes of the patterns, over the deviation of the strongest one."""
        patterns = self.constants["patterns"]
        amplitudes: Array = patterns @ normalise(frame).ravel() - self.constants["zero"]
        return amplitudes

    def combine(self, codes: list[Array]) -> Array:
        """Return the codes one after another."""
        return np.concatenate(codes)

    def nodes(self, pictures: str, out: str) -> Nodes:
        """Return `see` as operators of ONNX; see the base class."""
        from onnx import helper

        nodes, constants = normalise_nodes(pictures, "lit", self.stack.size)
        rows = np.array([self.stack.frames, self.stack.size**2])
        constants |= {**self.constants, "rows": rows, "joined": np.array([1, self.outputs])}
        nodes += [
            helper.make_node("Reshape", ["lit", "rows"], ["flat"]),
            helper.make_node("Gemm", ["flat", "patterns"], ["amplitudes"], transB=1),
            helper.make_node("Sub", ["amplitudes", "zero"], ["glimpses"]),
            helper.make_node("Reshape", ["glimpses", "joined"], [out]),
        ]
        return nodes, constants


def _odd_part(pictures: Array, axis: Axis) -> Array:
    """Return half the difference between pictures and their mirror images about an axis."""
    height, width = pictures.shape[1:]
    mirrored = 2.0 * axis.rows(height, width)[None, :] - np.arange(height)[:, None]
    below = np.floor(mirrored).astype(int)
    share = (mirrored - below).astype(np.float32)
    inside = (below >= 0) & (below < height - 1)
    below = np.where(inside, below, 0)
    columns = np.arange(width)[None, :]
    image = (1.0 - share) * pictures[:, below, columns] + share * pictures[:, below + 1, columns]
    odd = np.where(inside, pictures - image, 0.0)
    return (0.5 * odd).astype(np.float32)


class CnnExtractor(FeatureExtractor):
    """Extractor of the newest frame and differences of frames, shrunk, about the axis."""

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
        """Return the difference to the mean picture, over the standard deviation."""
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


class NatureExtractor(FeatureExtractor):
    """A feature extractor that returns the frames unchanged, scaled to 0 to 1, as in the paper."""

    network = "nature"

    def __init__(self, stack: StackSettings) -> None:
        super().__init__(stack)
        self.shape = (stack.frames, stack.size, stack.size)
        self.outputs = stack.frames * stack.size**2
        self.shapes = {}

    def fit(self, frames: Pixels, angles: NDArray[np.float64]) -> None:
        """Do nothing: this feature extractor has no constants."""

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


def make_extractor(settings: TrainingSettings) -> FeatureExtractor | None:
    """Return the extractor of a training, not yet fitted; None for an agent without pictures."""
    camera = settings.camera
    if settings.see == "force":
        return None
    if camera.feature_extractor == "modes":
        return ModesExtractor(camera.stack, camera.modes, camera.memory, camera.align)
    if camera.feature_extractor == "cnn":
        return CnnExtractor(camera.stack, camera.align)
    return NatureExtractor(camera.stack)


def random_angles(seed: int, ticks: int, amplitude: float) -> NDArray[np.float64]:
    """Return random instruction angles, independent of the pictures, shape (ticks,) [rad].

    The second half is the first one mirrored, so that the mean picture favours no side.

    ticks: number of angles
    amplitude: largest angle [rad]
    """
    random = np.random.default_rng([seed, 1])
    half = math.ceil(ticks / 2)
    levels = random.uniform(-amplitude, amplitude, half)
    angles = np.repeat(levels, random.integers(1, _MAX_HOLD_TICKS + 1, half))[:half]
    return np.concatenate((angles, -angles))[:ticks]
