"""Calibrations of force sensor and servo: volts to newtons, and angles to pulse widths."""

import math
from typing import Annotated, Literal, TypeVar

from msgspec import Struct

from fishd.core.schema import note, unit

Direction = Annotated[Literal[1, -1], note("1 or -1: which way a positive angle turns.")]
Trim = Annotated[
    float, unit("us", "Correction of the centre that makes the fin straight.", ge=-500, le=500)
]
Scale = Annotated[float, unit("us/rad", "Change of the pulse per angle.", ge=10, le=5000)]
Lowest = Annotated[float, unit("rad", "Soft limit: the lowest permitted angle.", ge=-math.pi, le=0)]
Highest = Annotated[
    float, unit("rad", "Soft limit: the highest permitted angle.", ge=0, le=math.pi)
]

Covariance = tuple[float, float, float]
"""Variance of a row's first gain, covariance of both, and variance of the second [N²/V²]."""

Z95 = 1.96
"""Half-width of a 95 % interval, in standard deviations of a normal distribution."""
MAX_CONDITION_NUMBER = 1e5
"""Largest condition number of a calibration matrix that can separate the two forces; that of a
fit is far smaller."""


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
    """Date of the calibration, ISO 8601; empty for the default."""
    loads: int = 0
    """Number of loads of the fit; 0 for a calibration that was not fitted."""
    residual: float = 0.0
    """Root mean square of the residuals of the fit [N]."""
    condition: float = 0.0
    """Condition number of the fit."""
    covariance_x: Covariance | None = None
    """Covariance of xx and xy; null if the uncertainty of this calibration is unknown.

    `Z95` times the root of a variance is the half-width of a 95 % confidence interval.
    """
    covariance_y: Covariance | None = None
    """Covariance of yx and yy; null if unknown."""
    load_ci95: float | None = None
    """Half-width of the 95 % confidence interval of the error that all loads share, as a fraction
    of a load; part of both covariances, null if they are null."""
    tare_date: str = ""
    """Date of the latest tare, which set x0 and y0, ISO 8601; empty if there was none."""

    def forces(self, vx: float, vy: float) -> tuple[float, float]:
        """Return F_x and F_y [N] for two voltages [V]."""
        return (self.xx * vx + self.xy * vy + self.x0, self.yx * vx + self.yy * vy + self.y0)

    def thrust_ci95(self, fx: float, fy: float = 0.0) -> float | None:
        """Return the half-width of the 95 % confidence interval of a force difference [N].

        It covers the uncertainty of the gains only: a difference, such as that of swimming to rest,
        does not depend on the zeros. None if the uncertainty of this calibration is unknown.

        fx, fy: differences of F_x and F_y at the same time [N]
        """
        if self.covariance_x is None:
            return None
        determinant = self.xx * self.yy - self.xy * self.yx
        vx = (self.yy * fx - self.xy * fy) / determinant
        vy = (self.xx * fy - self.yx * fx) / determinant
        first, both, second = self.covariance_x
        return Z95 * math.sqrt(max(0.0, first * vx**2 + 2.0 * both * vx * vy + second * vy**2))

    @property
    def is_unset(self) -> bool:
        """True if the matrix is the default, which takes volts for newtons; a tare may be set."""
        return self.loads == 0 and (self.xx, self.xy, self.yx, self.yy) == (1.0, 0.0, 0.0, 1.0)

    @property
    def is_singular(self) -> bool:
        """True if the matrix, whatever its scale, cannot separate F_x from F_y."""
        gains = (self.xx, self.xy, self.yx, self.yy)
        largest = max(map(abs, gains))
        if largest == 0.0:
            return True
        xx, xy, yx, yy = (gain / largest for gain in gains)
        # With singular values s and t: s t = |det|, s² + t² = sum of squares, condition = s / t.
        squares = xx * xx + xy * xy + yx * yx + yy * yy
        determinant = abs(xx * yy - xy * yx)
        return squares > determinant * (MAX_CONDITION_NUMBER + 1.0 / MAX_CONDITION_NUMBER)


EXACT = ForceCalibration(covariance_x=(0.0, 0.0, 0.0), covariance_y=(0.0, 0.0, 0.0), load_ci95=0.0)
"""Calibration of a simulated sensor: its gains are exact."""


class ServoCalibration(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Calibrated values of keys of section `servo`, which override the configuration."""

    trim: Trim = 0.0
    direction: Direction = 1
    scale: Scale = 600.0
    lowest: Lowest = -1.2
    highest: Highest = 1.2
    date: str = ""


class ForceSample(Struct, frozen=True):
    """Means and standard deviations of the output of the force sensor over some time."""

    pairs: int
    """Number of sample pairs."""
    seconds: float
    vx: float
    """[V]"""
    vy: float
    vx_std: float
    vy_std: float
    fx: float
    """Mean force by the active calibration [N]."""
    fy: float
    suspect: str | None = None
    """Reason not to trust this sample; None if there is none."""
    number: int = 0
    """Number by which a tare refers to this sample, for a limited time."""


C = TypeVar("C", ForceCalibration, ServoCalibration)
