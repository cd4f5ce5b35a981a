"""Turn and shift of the camera, from what stands still in a picture, such as the fish's body."""

import math

import cv2
import numpy as np

from fishd.camera.tail.ground import Floats, Ground
from fishd.camera.tail.profile import Array
from fishd.core.camera_frames import Pixels

_BLUR_PX = 1.5
"""Standard deviation of the blur, which makes larger shifts visible [px of the small picture]."""
_MIN_GRADIENT = 0.04
"""Smallest gradient of a pixel that counts, relative to the contrast of the tail [1/px]."""
_MIN_PIXELS, _MAX_PIXELS = 60, 2500
"""Range of the number of pixels that are used: those with the largest gradients."""
_RIDGE = 1e-3 * np.eye(3)
_HUBER = 1.5
"""Deviation from which a pixel counts less, relative to the typical one."""


class Scene:
    """Background beside the tail, with whose edges pictures are compared."""

    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        self._level = _blur(ground.background)
        down, along = np.gradient(self._level)
        still = cv2.erode(ground.still.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        strength = np.hypot(down, along) * still
        least = max(
            _MIN_GRADIENT * ground.contrast,
            float(np.partition(strength, -_MAX_PIXELS, axis=None)[-_MAX_PIXELS])
            if strength.size > _MAX_PIXELS
            else 0.0,
        )
        self._rows, self._columns = np.nonzero(strength > least)
        self.is_blind = len(self._rows) < _MIN_PIXELS
        """Whether too few edges are seen."""
        gradient = np.stack([along, down], axis=2)[self._rows, self._columns]
        places = np.stack([self._columns, self._rows], axis=1).astype(np.float64)
        weight = (gradient**2).sum(axis=1)
        self._centre = weight @ places / max(float(weight.sum()), 1e-9)
        arm = places - self._centre
        turn = gradient[:, 1] * arm[:, 0] - gradient[:, 0] * arm[:, 1]
        self._table = -np.concatenate([gradient, turn[:, None]], axis=1).astype(np.float64)
        self._solve = np.linalg.solve(self._table.T @ self._table + _RIDGE, self._table.T)

    def find_pose(self, small: Pixels, light: Floats, steps: int = 1) -> tuple[Array, float]:
        """Return how a small picture is shifted along its rows and down [px of it], and turned.

        The second result is the typical difference that this leaves, relative to that without.

        steps: number of steps of the search; one sees changes of about a pixel exactly
        """
        pose, rest, first = np.zeros(3), np.zeros(1), 0.0
        if self.is_blind:
            return pose, 1.0
        even = _blur(np.asarray(small / light[:, None], np.float32))
        for step in range(steps):
            seen = self.undo(even, pose) if step else even
            difference = (seen - self._level)[self._rows, self._columns].astype(np.float64)
            first = first or float(np.median(np.abs(difference)))
            change = self._solve @ difference
            for _ in range(2):  # what deviates counts less
                rest = np.abs(difference - self._table @ change)
                limit = _HUBER * 1.4826 * float(np.median(rest)) + 1e-6
                weighted = self._table * (limit / np.maximum(rest, limit))[:, None]
                table = weighted.T @ self._table + _RIDGE
                change = np.asarray(np.linalg.solve(table, weighted.T @ difference), np.float64)
            pose += change
        return pose, float(np.median(rest)) / max(first, 1e-6)

    def undo(self, small: "Floats | Pixels", pose: Array) -> Floats:
        """Return a small picture as it would be without a pose of the camera."""
        c, s = math.cos(pose[2]), math.sin(pose[2])
        turn = np.array([[c, -s], [s, c]])
        offset = self._centre + pose[:2] - turn @ self._centre
        warp = np.concatenate([turn, offset[:, None]], axis=1)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(
            cv2.warpAffine(
                small, warp, small.shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
            ),
            np.float32,
        )


def _blur(picture: Floats) -> Floats:
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), _BLUR_PX), np.float32)
