"""The eye `modes`: the amplitudes of a few patterns of motion that follow the command.

It works like a lock-in amplifier: each pixel of the part of the picture that changes sign in the
mirror is regressed on the latest commands, and the strongest patterns of the explained part are
kept. Light, noise and ripples of the water do not follow the command, so they are suppressed.
"""

import numpy as np
from numpy.typing import NDArray

from fishd.camera.axis import Axis, find_motion
from fishd.core.camera_frames import Pixels, StackSettings
from fishd.learning.eyes.base import Array, Eye, Nodes, normalise, normalise_nodes


class ModesEye(Eye):
    """An eye that returns the amplitudes of a few patterns in each frame, newest frame first."""

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
        ]  # so that another eye has the same signs
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
