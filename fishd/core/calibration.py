"""Calibrations of force sensor and servo: what voltages and angles are believed to mean."""

import math
from typing import Annotated, Literal, TypeVar

from msgspec import Struct

from fishd.core.schema import note, unit

Direction = Annotated[Literal[1, -1], note("1 or -1: which way a positive angle turns.")]
Trim = Annotated[
    float, unit("us", "Correction of the centre that makes the fin straight.", ge=-500, le=500)
]
Scale = Annotated[float, unit("us/rad", "Change of the pulse per angle.", ge=10, le=5000)]
Lowest = Annotated[float, unit("rad", "Soft limit: no angle below.", ge=-math.pi, le=0)]
Highest = Annotated[float, unit("rad", "Soft limit: no angle above.", ge=0, le=math.pi)]

Covariance = tuple[float, float, float]
"""Variance of a row's first gain, covariance of both, and variance of the second [N²/V²]."""

Z95 = 1.96
"""Half-width of a 95 % interval, in standard deviations of a normal distribution."""
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
    covariance_x: Covariance | None = None
    """Covariance of xx and xy; null where the uncertainty of this calibration is unknown.

    `Z95` times the root of a variance is the half-width of a 95 % confidence interval.
    """
    covariance_y: Covariance | None = None
    """Covariance of yx and yy, in the same way."""
    load_error: float | None = None
    """Half-width of the 95 % interval of the error that all loads share, as a fraction of a load;
    part of both covariances, null where they are null."""
    tared: str = ""
    """When x0 and y0 were last set by a tare, ISO 8601; empty for never."""

    def forces(self, vx: float, vy: float) -> tuple[float, float]:
        """F_x and F_y [N] for two voltages [V]."""
        return (
            self.xx * vx + self.xy * vy + self.x0,
            self.yx * vx + self.yy * vy + self.y0,
        )

    def thrust_ci95(self, fx: float, fy: float = 0.0) -> float | None:
        """Return the half-width of the 95 % interval that the gains leave to a force fx [N].

        The force is a difference, such as that of swimming to rest, so that no zero is in it.
        fy: the difference of F_y at the same time [N]
        None where the uncertainty of this calibration is unknown.
        """
        if self.covariance_x is None:
            return None
        determinant = self.xx * self.yy - self.xy * self.yx
        vx = (self.yy * fx - self.xy * fy) / determinant
        vy = (self.xx * fy - self.yx * fx) / determinant
        first, both, second = self.covariance_x
        return Z95 * math.sqrt(max(0.0, first * vx**2 + 2.0 * both * vx * vy + second * vy**2))

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


EXACT = ForceCalibration(covariance_x=(0.0, 0.0, 0.0), covariance_y=(0.0, 0.0, 0.0), load_error=0.0)
"""Calibration of a simulated sensor: its gains are exact."""


class ServoCalibration(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The keys of section `servo` that a calibration finds; takes precedence over them."""

    trim: Trim = 0.0
    direction: Direction = 1
    scale: Scale = 600.0
    lowest: Lowest = -1.2
    highest: Highest = 1.2
    date: str = ""


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
    """By the calibration that is used [N]."""
    fy: float
    suspect: str = ""
    """Why this is not to be believed; empty where it is."""
    number: int = 0
    """By which a tare names it, for a while."""


C = TypeVar("C", ForceCalibration, ServoCalibration)
