"""Calibrations of force sensor and servo: what voltages and angles are believed to mean."""

import math
from typing import Annotated, Literal, TypeVar

import msgspec
from msgspec import Meta, Struct

from fishd.hardware.settings import ServoSettings

WORST_CONDITION = 1e5
"""A matrix of a larger condition number says the same of both forces; that of a fit is less."""


class ForceCalibration(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """F_x = xx V_x + xy V_y + x0 and F_y = yx V_x + yy V_y + y0; volts to newtons."""

    xx: float = 1.0
    """[N/V]"""
    xy: float = 0.0
    x0: float = 0.0
    """[N]"""
    yx: float = 0.0
    yy: float = 1.0
    y0: float = 0.0
    date: str = ""
    """When it was made, ISO 8601; empty for one that nobody made."""
    loads: int = 0
    """How many loads it was fitted to; 0 for one that was not."""
    residual: float = 0.0
    """Root mean square of what the fit leaves over [N]."""
    condition: float = 0.0
    """Condition number of the fit."""
    tared: str = ""
    """When x0 and y0 were last set by a tare, ISO 8601; empty for never."""

    def forces(self, vx: float, vy: float) -> tuple[float, float]:
        """F_x and F_y [N] for two voltages [V]."""
        return (
            self.xx * vx + self.xy * vy + self.x0,
            self.yx * vx + self.yy * vy + self.y0,
        )

    @property
    def untouched(self) -> bool:
        """True while nobody found the matrix, and volts count as newtons; a tare does not."""
        return self.loads == 0 and (self.xx, self.xy, self.yx, self.yy) == (1.0, 0.0, 0.0, 1.0)

    @property
    def singular(self) -> bool:
        """True where the matrix, whatever its size, does not tell F_x from F_y."""
        gains = (self.xx, self.xy, self.yx, self.yy)
        largest = max(map(abs, gains))
        if largest == 0.0:
            return True
        xx, xy, yx, yy = (gain / largest for gain in gains)
        # With singular values s and t: s t = |det|, s² + t² = sum of squares, condition = s / t.
        squares = xx * xx + xy * xy + yx * yx + yy * yy
        determinant = abs(xx * yy - xy * yx)
        return squares > determinant * (WORST_CONDITION + 1.0 / WORST_CONDITION)


class ServoCalibration(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What the same keys of section `servo` mean, with their bounds; takes precedence over them."""

    trim: Annotated[float, Meta(ge=-500, le=500)] = 0.0
    """[µs]"""
    direction: Literal[1, -1] = 1
    scale: Annotated[float, Meta(ge=10, le=5000)] = 600.0
    """[µs/rad]"""
    lowest: Annotated[float, Meta(ge=-math.pi, le=0)] = -1.2
    """[rad]"""
    highest: Annotated[float, Meta(ge=0, le=math.pi)] = 1.2
    """[rad]"""
    date: str = ""


def calibrated(settings: ServoSettings, calibration: ServoCalibration) -> ServoSettings:
    """The settings with what a calibration says instead."""
    return msgspec.structs.replace(
        settings,
        trim=calibration.trim,
        direction=calibration.direction,
        scale=calibration.scale,
        lowest=calibration.lowest,
        highest=calibration.highest,
    )


def as_configured(settings: ServoSettings) -> ServoCalibration:
    """The calibration that the settings themselves amount to."""
    return ServoCalibration(
        trim=settings.trim,
        direction=settings.direction,
        scale=settings.scale,
        lowest=settings.lowest,
        highest=settings.highest,
    )


class ForceSample(Struct, frozen=True):
    """What the force sensor said over a while; means and standard deviations over pairs."""

    pairs: int
    seconds: float
    vx: float
    """[V]"""
    vy: float
    vx_std: float
    vy_std: float
    fx: float
    """By the calibration in force [N]."""
    fy: float
    suspect: str = ""
    """Why this is not to be believed; empty where it is."""
    number: int = 0
    """By which a tare names it, for a while."""


C = TypeVar("C", ForceCalibration, ServoCalibration)
