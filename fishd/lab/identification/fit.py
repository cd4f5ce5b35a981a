"""Least-squares fit of the simulated response to measured forces.

The offset of the sensor drifts as a local linear trend, whose strengths are estimated by maximum
likelihood. The residual of each channel is filtered such that this drift plus white noise becomes
white, which yields the innovations of the trend in the steady state (Harvey, "Forecasting,
structural time series models and the Kalman filter"). Level and slope at the start of a passage
are projected out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.signal import lfilter

from fishd.lab.identification.passages import Passage
from fishd.lab.identification.response import Array, Drive, Motion, respond
from fishd.virtual.plant.servo_law import ServoLaw

DRIVE = (
    *("omega0", "xi", "quadratic_drag", "servo_speed", "servo_lag"),
    *("servo_delay", "backlash", "cable_slack", "servo_dead_zone"),
)
"""Parameters that change the motion of the fin, so that the response is simulated again."""
FORCES = (
    *("coupling", "thrust_coefficient", "lateral_inertia_ratio", "lateral_drag"),
    *("lateral_quadratic_drag", "servo_reaction", "rotation"),
)
"""Parameters that scale and rotate the forces of a motion."""
FURTHER = ("lateral_quadratic_drag", "servo_reaction", "cable_slack", "servo_dead_zone")
"""Parameters that are fitted only where the residual resembles their effect."""
QUADRATIC = ("quadratic_drag", "lateral_quadratic_drag")
BOUNDS = {
    "omega0": (0.5, 200.0),
    "xi": (1e-3, 10.0),
    "quadratic_drag": (0.0, 100.0),
    "servo_speed": (0.05, 1e3),
    "servo_lag": (5e-3, 10.0),
    "servo_delay": (0.0, 0.5),
    "backlash": (0.0, 0.5),
    "cable_slack": (0.0, 0.5),
    "servo_dead_zone": (0.0, 0.5),
    "coupling": (1e-3, 10.0),
    "thrust_coefficient": (1e-8, 10.0),
    "lateral_inertia_ratio": (0.01, 100.0),
    "lateral_drag": (0.0, 10.0),
    "lateral_quadratic_drag": (0.0, 10.0),
    "servo_reaction": (-0.1, 0.1),
    "rotation": (-1.5, 1.5),
}
"""Bounds of the parameters in a fit, in the units of the configuration."""
LOGARITHMIC = frozenset(
    (
        *("omega0", "xi", "servo_speed", "servo_lag"),
        *("coupling", "thrust_coefficient", "lateral_inertia_ratio"),
    )
)
"""Parameters fitted as logarithms: they are positive, and their errors are relative."""
SIGNED = ("servo_reaction", "rotation")
"""Parameters that may be negative."""
STEPS = {
    "servo_delay": 1e-4,
    "backlash": 2e-4,
    "cable_slack": 2e-4,
    "servo_dead_zone": 2e-4,
    "quadratic_drag": 1e-3,
}
"""Steps of finite differences of a motion; 1e-4 for parameters that are not listed."""


@dataclass(frozen=True)
class Noise:
    """Noise model of one channel of the sensor: white noise on a level with a drifting slope."""

    innovation: float
    """Rms of the innovations [N]."""
    level: float
    """Gain from an innovation to the level, 0 to 1."""
    slope: float
    """Gain from an innovation to the slope, per tick."""

    @property
    def white(self) -> float:
        """Rms of the white part [N]."""
        return self.innovation * float(np.sqrt(1.0 - self.level))


class Problem:
    """The residual of passages as a function of the fitted parameters, and its derivatives.

    Attributes:
        names: names of the fitted parameters, in the order of the vector z, which holds the
            logarithms of those in `LOGARITHMIC`.
        law: law by which the servo approaches its instruction.
        noise: noise models of F_x and F_y.
    """

    def __init__(
        self,
        passages: Sequence[Passage],
        names: Sequence[str],
        settle: float,
        law: ServoLaw = "tanh",
    ) -> None:
        """settle: time at the start of a passage that is left out [s]; law: that of the servo"""
        self.names = tuple(names)
        self.law = law
        self.noise = (Noise(1.0, 0.1, 0.005), Noise(1.0, 0.1, 0.005))
        self._settle = settle
        self._passages = [
            (passage, int(np.searchsorted(passage.ends[1:] * passage.tick, settle)))
            for passage in passages
        ]
        self._cached: tuple[dict[str, float], list[Array]] | None = None
        self._latest_motions: list[Motion | None] = [None for _ in passages]

    def changed(self, names: Sequence[str], law: ServoLaw) -> "Problem":
        """Return the problem of the same passages with other parameters and another law."""
        return Problem(self.passages, names, self._settle, law)

    def to_z(self, values: dict[str, float]) -> Array:
        """Return the vector z of the fitted parameters, clipped to their bounds."""
        clipped = [float(np.clip(values[name], *BOUNDS[name])) for name in self.names]
        pairs = zip(self.names, clipped, strict=True)
        return np.array([np.log(v) if name in LOGARITHMIC else v for name, v in pairs])

    def to_values(self, z: Array, fixed: dict[str, float]) -> dict[str, float]:
        """Return all parameters for a vector z, with those in `fixed` that are not fitted."""
        pairs = zip(self.names, z.tolist(), strict=True)
        fitted = {name: float(np.exp(v)) if name in LOGARITHMIC else v for name, v in pairs}
        return {**fixed, **fitted}

    def bounds(self) -> tuple[Array, Array]:
        """Return the lower and the upper bounds of z."""
        lowest, highest = ({name: BOUNDS[name][end] for name in self.names} for end in (0, 1))
        return self.to_z(lowest), self.to_z(highest)

    @property
    def passages(self) -> list[Passage]:
        """The fitted passages."""
        return [passage for passage, _ in self._passages]

    @property
    def settle(self) -> float:
        """Time at the start of a passage that is left out [s]."""
        return self._settle

    @property
    def skips(self) -> list[int]:
        """Number of windows at the start of each passage that are left out."""
        return [skip for _, skip in self._passages]

    @property
    def unexplained(self) -> float:
        """Sum of the log-rms of the innovations of both forces; smaller is more likely."""
        return float(sum(np.log(noise.innovation) for noise in self.noise))

    @property
    def measured(self) -> list[Array]:
        """Measured forces [N] by passage, each of shape (2, windows)."""
        return [passage.forces[:, skip:] for passage, skip in self._passages]

    @property
    def times(self) -> list[Array]:
        """Ends of the windows [s] by passage."""
        return [passage.times[skip:] for passage, skip in self._passages]

    def forces(self, values: dict[str, float]) -> list[Array]:
        """Return simulated forces [N] by passage, without offset and noise, each (2, windows)."""
        pairs = zip(self._responses(values), self._passages, strict=True)
        return [_to_sensor_forces(values, moved)[:, skip:] for moved, (_, skip) in pairs]

    def residuals(self, values: dict[str, float]) -> list[Array]:
        """Return measured minus simulated forces [N] by passage, each (2, windows)."""
        pairs = zip(self.measured, self.forces(values), strict=True)
        return [measured - simulated for measured, simulated in pairs]

    def whitened(self, residuals: Sequence[Array]) -> Array:
        """Return innovations of both channels in units of their rms, passages joined, (2, n)."""
        return np.stack(
            [
                np.concatenate(
                    [
                        _innovations(residual[channel], noise)[0] / noise.innovation
                        for residual in residuals
                    ]
                )
                for channel, noise in enumerate(self.noise)
            ]
        )

    def jacobian(self, values: dict[str, float]) -> Array:
        """Return the derivatives of `whitened(residuals(…))` by z, shape (2, n, names)."""
        columns = [self.whitened(self._derivative(values, name)) for name in self.names]
        return np.stack(columns, axis=2)

    def column(self, values: dict[str, float], name: str, step: float | None) -> Array:
        """Return the derivative of `whitened(residuals(…))` by any parameter, shape (2, n).

        step: step of the finite difference; by default that of a fit
        """
        return self.whitened(self._derivative(values, name, step))

    def slopes_of_means(self, values: dict[str, float]) -> Array:
        """Return the derivatives of the mean residual of both channels by z, shape (2, names)."""
        slopes = [np.concatenate(self._derivative(values, name), axis=1) for name in self.names]
        return np.stack([slope.mean(axis=1) for slope in slopes], axis=1)

    def estimate_noise(self, residuals: Sequence[Array]) -> None:
        """Set `noise` to the maximum-likelihood estimate for residuals."""
        models = [
            estimate_noise_model([residual[channel] for residual in residuals])
            for channel in range(2)
        ]
        self.noise = (models[0], models[1])

    def _derivative(
        self, values: dict[str, float], name: str, step: float | None = None
    ) -> list[Array]:
        """Return the derivative of the residuals by one element of z, by passage."""
        value = values[name]
        step = step or STEPS.get(name, 1e-4) * (value if name in LOGARITHMIC else 1.0)
        if name in FORCES and not (name == "coupling" and values["quadratic_drag"]):
            step = 1e-6 * max(1e-3, abs(value))
        later = {**values, name: value + step}
        moved, moved_later = self._responses(values), self._responses(later, keep=False)
        scale = (value if name in LOGARITHMIC else 1.0) / step
        return [
            ((_to_sensor_forces(values, a) - _to_sensor_forces(later, b)) * scale)[:, skip:]
            for a, b, (_, skip) in zip(moved, moved_later, self._passages, strict=True)
        ]

    def _responses(self, values: dict[str, float], *, keep: bool = True) -> list[Array]:
        """Return the response of the fin for λ = 1 by passage; cache the latest one."""
        drive = self._drive(values)
        if self._cached and self._cached[0] == drive:
            return self._cached[1]
        responses = self._respond(drive)
        moved = [forces for forces, _ in responses]
        if keep:
            self._cached, self._latest_motions = (drive, moved), [motion for _, motion in responses]
        return moved

    def motions(self, values: dict[str, float]) -> list[Motion]:
        """Return the motion of the fin for λ = 1, by passage."""
        return [motion for _, motion in self._respond(self._drive(values))]

    def _drive(self, values: dict[str, float]) -> dict[str, float]:
        drive = {name: values[name] for name in DRIVE}
        drive["quadratic_drag"] *= values["coupling"]
        return drive

    def _respond(self, drive: dict[str, float]) -> list[tuple[Array, Motion]]:
        model = Drive(**drive, servo_law=self.law)
        return [
            respond(model, passage.angles, passage.timing, near)
            for (passage, _), near in zip(self._passages, self._latest_motions, strict=True)
        ]


def solve(
    problem: Problem, start: dict[str, float], rounds: int = 3, steps: int = 40
) -> dict[str, float]:
    """Return the maximum-likelihood parameters, and set `problem.noise` accordingly.

    start: start values of all parameters; those that are not fitted keep them
    rounds: largest number of estimates of the noise
    steps: largest number of least-squares steps in each round
    """
    values = start
    low, high = problem.bounds()
    problem.estimate_noise(problem.residuals(values))
    for round_index in range(rounds):
        fixed = values

        def residual(z: Array, fixed: dict[str, float] = fixed) -> Array:
            return problem.whitened(problem.residuals(problem.to_values(z, fixed))).ravel()

        def jacobian(z: Array, fixed: dict[str, float] = fixed) -> Array:
            return problem.jacobian(problem.to_values(z, fixed)).reshape(-1, len(z))

        solution = least_squares(
            residual,
            problem.to_z(values),
            jac=jacobian,
            bounds=(low, high),
            x_scale="jac",
            xtol=1e-5,
            ftol=1e-6,
            max_nfev=steps,
        )
        values = problem.to_values(solution.x, fixed)
        previous_noise = problem.noise
        problem.estimate_noise(problem.residuals(values))
        if round_index and all(
            abs(new.innovation / old.innovation - 1.0) < 1e-3
            for new, old in zip(problem.noise, previous_noise, strict=True)
        ):
            break
    return values


def _to_sensor_forces(values: dict[str, float], moved: Array) -> Array:
    """Return the forces of a response in the axes of a rotated sensor, shape (2, windows)."""
    scale, inertia, drag = (values[n] for n in ("coupling", "thrust_coefficient", "lateral_drag"))
    fx = inertia * scale * scale * moved[0]
    fy = scale * (values["lateral_inertia_ratio"] * inertia * moved[1] + drag * moved[2])
    fy = fy + values["lateral_quadratic_drag"] * scale * scale * moved[4]
    fy = fy + values["servo_reaction"] * moved[3]
    cos, sin = np.cos(values["rotation"]), np.sin(values["rotation"])
    return np.stack((cos * fx - sin * fy, sin * fx + cos * fy))


def estimate_noise_model(residuals: Sequence[Array]) -> Noise:
    """Return the maximum-likelihood noise model of one channel, from its residual by passage."""
    count = sum(map(len, residuals))

    def noise(x: Array) -> Noise:
        # Gains of a steady Kalman filter: level in 0 … 1, slope up to level² / (2 − level).
        level = 1.0 / (1.0 + float(np.exp(-x[0])))
        slope_share = 1.0 / (1.0 + float(np.exp(-x[1])))
        return Noise(1.0, level, slope_share * level * level / (2.0 - level))

    def cost(x: Array) -> float:
        parts = [_innovations(residual, noise(x)) for residual in residuals]
        squares = sum(float(residual @ residual) for residual, _ in parts)
        return count * float(np.log(squares)) + sum(loss for _, loss in parts)

    best = noise(minimize(cost, [-3.0, -1.0], method="Nelder-Mead", options={"xatol": 0.02}).x)
    squares = sum(float(np.sum(_innovations(residual, best)[0] ** 2)) for residual in residuals)
    return replace(best, innovation=float(np.sqrt(squares / count)))


def _innovations(residual: Array, noise: Noise) -> tuple[Array, float]:
    """Return the innovations of a residual, with the initial level and slope projected out.

    The second result is twice the loss of log-likelihood by not knowing these two.
    """
    filtered = lfilter(*_filter_coefficients(noise), residual)
    basis, loss = _initial_state_basis(noise, len(residual))
    return filtered - basis @ (basis.T @ filtered), loss


def _filter_coefficients(noise: Noise) -> tuple[list[float], list[float]]:
    """Return numerator and denominator of the whitening filter, in z⁻¹."""
    return [1.0, -2.0, 1.0], [1.0, noise.level + noise.slope - 2.0, 1.0 - noise.level]


@lru_cache(maxsize=64)
def _initial_state_basis(noise: Noise, count: int) -> tuple[Array, float]:
    """Return an orthonormal basis of the filtered initial level and slope, and twice its log-norm.

    The basis has the shape (count, 2).
    """
    _, denominator = _filter_coefficients(noise)
    impulse = np.zeros(count)
    impulse[0] = 1.0
    columns = lfilter([1.0, -1.0], denominator, impulse), lfilter([0.0, 1.0], denominator, impulse)
    basis, triangle = np.linalg.qr(np.stack(columns, axis=1))
    return basis, 2.0 * float(np.log(np.abs(np.diag(triangle))).sum())
