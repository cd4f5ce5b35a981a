"""`two-segments`: a tail in two pieces. The servo moves the first; a spring holds the tip to it.

With the angle α of the first piece and β of the tip, each against the axis of the fish, and the
tip's share s of the inertia:

    φ̇ = Ω tanh((φ_c − φ)/Δ)
    α̈ = −ξω₀ α̇ − ω₀² (α − λφ) + s/(1 − s) ω_t² (β − α)
    β̈ = −ζω_t β̇ − ω_t² (β − α)
    F_x = −K ((1 − s) α α̈ + s β β̈)
    F_y = −K_y ((1 − s) α̈ + s β̈) − K_d ((1 − s) α̇ + s β̇)
"""

import math
from typing import Annotated

from fishd.virtual.plant.base import (
    REST,
    Plant,
    PlantParameters,
    PlantState,
    PlantWindow,
    Problem,
    unit,
)

MAX_STEP_S = 0.003
"""Longest step of the integration [s]."""
UNSUPPORTED_KEYS = (
    "quadratic_drag",
    "lateral_quadratic_drag",
    "cable_slack",
    "backlash",
    "servo_delay",
    "servo_dead_zone",
    "servo_reaction",
)
"""Keys of every plant that have no equation in this one."""

Numbers = tuple[float, ...]


class TwoSegmentsParameters(PlantParameters, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the tip, in addition to the keys of every plant."""

    tip_omega0: Annotated[
        float, unit("rad/s", "Natural angular frequency of the tip, ω_t.", ge=1.0, le=100.0)
    ] = 20.0
    tip_xi: Annotated[float, unit("1", "Damping of the tip, ζ.", ge=0.0, le=20.0)] = 0.6
    tip_share: Annotated[float, unit("1", "The tip's share s of the inertia.", ge=0.0, le=0.9)] = (
        0.3
    )


class TwoSegments(Plant[TwoSegmentsParameters]):
    """A fish whose tail has a passive tip."""

    Settings = TwoSegmentsParameters

    def __init__(self, parameters: TwoSegmentsParameters) -> None:
        super().__init__(parameters)
        self.state = REST
        self._tip = (0.0, 0.0)  # β [rad] and β̇ [rad/s]

    @classmethod
    def check(cls, parameters: TwoSegmentsParameters) -> None:
        """Refuse keys that have no equation in this plant."""
        for key in UNSUPPORTED_KEYS:
            if value := getattr(parameters, key):
                raise Problem((key,), f"{value:g} is not valid: this plant has none; 0 is needed")

    def advance(
        self, instruction_angle: float | None, duration: float, samples: int
    ) -> PlantWindow:
        """Implement `Plant.advance` by the Runge–Kutta method of order 4."""
        target = self.state.phi if instruction_angle is None else instruction_angle
        # An even number of steps for each sample, as a sample is taken in the middle.
        steps = 2 * math.ceil(0.5 * duration / samples / MAX_STEP_S)
        h = duration / samples / steps
        y: Numbers = (*self.state, *self._tip, 0.0, 0.0)
        sampled = [0.0, 0.0]
        peak = abs(self.state.alpha)
        for _ in range(samples):
            for k in range(steps):
                y = self._step(y, target, h)
                peak = max(peak, abs(y[1]))
                if 2 * (k + 1) == steps:
                    *_, fx, fy = self._rates(y, target)
                    sampled[0] += fx / samples
                    sampled[1] += fy / samples
        self.state, self._tip = PlantState(*y[:3]), y[3:5]
        return PlantWindow(duration, y[5] / duration, y[6] / duration, *sampled, fin_peak=peak)

    def _step(self, y: Numbers, target: float, h: float) -> Numbers:
        k1 = self._rates(y, target)
        k2 = self._rates(_extrapolate(y, k1, 0.5 * h), target)
        k3 = self._rates(_extrapolate(y, k2, 0.5 * h), target)
        k4 = self._rates(_extrapolate(y, k3, h), target)
        mean = [(a + 2.0 * (b + c) + d) / 6.0 for a, b, c, d in zip(k1, k2, k3, k4, strict=True)]
        return _extrapolate(y, mean, h)

    def _rates(self, y: Numbers, target: float) -> Numbers:
        """Return the rates of φ, α, α̇, β, β̇; then F_x and F_y, whose integrals are impulses."""
        p = self.parameters
        phi, alpha, alpha_rate, beta, beta_rate, *_ = y
        turning = p.servo_speed * math.tanh((target - phi) / p.servo_lag)
        s, pull = p.tip_share, p.tip_omega0**2 * (beta - alpha)
        a = -p.xi * p.omega0 * alpha_rate - p.omega0**2 * (alpha - p.coupling * phi)
        a += s / (1.0 - s) * pull
        b = -p.tip_xi * p.tip_omega0 * beta_rate - pull
        fx = -p.thrust_coefficient * ((1.0 - s) * alpha * a + s * beta * b)
        fy = -p.lateral_inertia * ((1.0 - s) * a + s * b)
        fy -= p.lateral_drag * ((1.0 - s) * alpha_rate + s * beta_rate)
        return turning, alpha_rate, a, beta_rate, b, fx, fy


def _extrapolate(y: Numbers, rates: Numbers, time: float) -> Numbers:
    return tuple(value + time * rate for value, rate in zip(y, rates, strict=True))
