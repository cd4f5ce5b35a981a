"""Least squares on the simulated response: the parameters that explain measured forces best.

The offset of the sensor drifts: it is a level whose slope wanders, by likeliest strengths. The
residual of each channel is filtered such that this drift plus white noise becomes white, which are
the innovations of a local linear trend in the steady state (Harvey, "Forecasting, structural time
series models and the Kalman filter"). Level and slope at the start of a passage are projected out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.optimize import least_squares, minimize
from scipy.signal import lfilter

from fishd.lab.identification.passages import Passage
from fishd.lab.identification.response import Array, Drive, Motion, respond

DRIVE = (
    *("omega0", "xi", "quadratic_drag", "servo_speed", "servo_lag"),
    *("servo_delay", "backlash", "cable_slack", "servo_dead_zone"),
)
"""What shapes the motion of the fin: the response is simulated for each."""
FORCES = (
    *("coupling", "thrust_coefficient", "lateral_inertia_ratio", "lateral_drag"),
    *("lateral_quadratic_drag", "servo_reaction", "rotation"),
)
"""What scales and turns the forces of a motion."""
FURTHER = ("lateral_quadratic_drag", "servo_reaction", "cable_slack", "servo_dead_zone")
"""What is fitted, unless that is fixed, only where what is left over looks like it."""
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
"""Where a fit looks, in the units of the configuration."""
LOGARITHMIC = frozenset(
    (
        *("omega0", "xi", "servo_speed", "servo_lag"),
        *("coupling", "thrust_coefficient", "lateral_inertia_ratio"),
    )
)
"""Fitted as logarithms: they are positive, and errors of them are shares."""
SIGNED = ("servo_reaction", "rotation")
"""These may be negative."""
_STEPS = {
    "servo_delay": 1e-4,
    "backlash": 2e-4,
    "cable_slack": 2e-4,
    "servo_dead_zone": 2e-4,
    "quadratic_drag": 1e-3,
}
"""For differences; 1e-4 elsewhere."""


@dataclass(frozen=True)
class Noise:
    """What the sensor adds in one channel: white noise on a level that drifts, with its slope."""

    innovation: float
    """Rms of what cannot be predicted of a tick [N]."""
    level: float
    """How much of it changes what is expected of the level, 0 to 1."""
    slope: float
    """How much of it changes what is expected of the slope, per tick."""

    @property
    def white(self) -> float:
        """Rms of the white part [N]."""
        return self.innovation * float(np.sqrt(1.0 - self.level))


class Problem:
    """The residual of some passages as a function of what is fitted, and its derivatives.

    Attributes:
        names: what is fitted, in the order of the vector z; logarithms of some.
        noise: of F_x and F_y.
    """

    def __init__(self, passages: Sequence[Passage], names: Sequence[str], settle: float) -> None:
        """settle: how long the beginning of a passage is not judged [s]"""
        self.names = tuple(names)
        self.noise = (Noise(1.0, 0.1, 0.005), Noise(1.0, 0.1, 0.005))
        self._passages = [
            (one, int(np.searchsorted(one.ends[1:] * one.tick, settle))) for one in passages
        ]
        self._cached: tuple[dict[str, float], list[Array]] | None = None
        self._near: list[Motion | None] = [None for _ in passages]

    def to_z(self, values: dict[str, float]) -> Array:
        """The vector of what is fitted, within bounds."""
        clipped = [float(np.clip(values[name], *BOUNDS[name])) for name in self.names]
        pairs = zip(self.names, clipped, strict=True)
        return np.array([np.log(v) if name in LOGARITHMIC else v for name, v in pairs])

    def to_values(self, z: Array, fixed: dict[str, float]) -> dict[str, float]:
        """All values for a vector; those that are not fitted are `fixed`."""
        pairs = zip(self.names, z.tolist(), strict=True)
        fitted = {name: float(np.exp(v)) if name in LOGARITHMIC else v for name, v in pairs}
        return {**fixed, **fitted}

    def bounds(self) -> tuple[Array, Array]:
        """Of z."""
        lowest, highest = ({name: BOUNDS[name][end] for name in self.names} for end in (0, 1))
        return self.to_z(lowest), self.to_z(highest)

    @property
    def skips(self) -> list[int]:
        """How many windows at the start of each passage are not judged."""
        return [skip for _, skip in self._passages]

    @property
    def unexplained(self) -> float:
        """How much of both forces `noise` has to stand for, as a logarithm; smaller is likelier."""
        return float(sum(np.log(noise.innovation) for noise in self.noise))

    @property
    def measured(self) -> list[Array]:
        """The forces that are judged [N], by passage, each (2, windows)."""
        return [one.forces[:, skip:] for one, skip in self._passages]

    @property
    def times(self) -> list[Array]:
        """When their windows ended [s], by passage."""
        return [one.times[skip:] for one, skip in self._passages]

    def forces(self, values: dict[str, float]) -> list[Array]:
        """The same as a sensor without offset and noise would show them of this fish."""
        pairs = zip(self._moved(values), self._passages, strict=True)
        return [_seen(values, moved)[:, skip:] for moved, (_, skip) in pairs]

    def residuals(self, values: dict[str, float]) -> list[Array]:
        """Measured minus simulated forces [N], by passage, each (2, windows)."""
        pairs = zip(self.measured, self.forces(values), strict=True)
        return [measured - seen for measured, seen in pairs]

    def whitened(self, residuals: Sequence[Array]) -> Array:
        """Innovations of both channels in units of their rms, all passages in a row, (2, n)."""
        return np.stack(
            [
                np.concatenate(
                    [_innovations(each[channel], noise)[0] / noise.innovation for each in residuals]
                )
                for channel, noise in enumerate(self.noise)
            ]
        )

    def jacobian(self, values: dict[str, float]) -> Array:
        """Derivatives of `whitened(residuals(…))` by z, shape (2, n, names)."""
        columns = [self.whitened(self._slope(values, name)) for name in self.names]
        return np.stack(columns, axis=2)

    def column(self, values: dict[str, float], name: str, step: float | None) -> Array:
        """Derivative of `whitened(residuals(…))` by what need not be fitted, shape (2, n).

        step: of the difference; by default as for a fit
        """
        return self.whitened(self._slope(values, name, step))

    def slopes_of_means(self, values: dict[str, float]) -> Array:
        """Derivatives of the mean residual of both channels by z, shape (2, names)."""
        slopes = [np.concatenate(self._slope(values, name), axis=1) for name in self.names]
        return np.stack([slope.mean(axis=1) for slope in slopes], axis=1)

    def estimate_noise(self, residuals: Sequence[Array]) -> None:
        """Set `noise` to what is likeliest for these residuals."""
        found = [likeliest([each[channel] for each in residuals]) for channel in range(2)]
        self.noise = (found[0], found[1])

    def _slope(self, values: dict[str, float], name: str, step: float | None = None) -> list[Array]:
        """Derivative of the residuals by one element of z, by passage."""
        value = values[name]
        step = step or _STEPS.get(name, 1e-4) * (value if name in LOGARITHMIC else 1.0)
        if name in FORCES and not (name == "coupling" and values["quadratic_drag"]):
            step = 1e-6 * max(1e-3, abs(value))
        later = {**values, name: value + step}
        moved, moved_later = self._moved(values), self._moved(later, keep=False)
        scale = (value if name in LOGARITHMIC else 1.0) / step
        return [
            ((_seen(values, a) - _seen(later, b)) * scale)[:, skip:]
            for a, b, (_, skip) in zip(moved, moved_later, self._passages, strict=True)
        ]

    def _moved(self, values: dict[str, float], *, keep: bool = True) -> list[Array]:
        """The response of the fin for λ = 1, by passage; the latest one is kept."""
        drive = {name: values[name] for name in DRIVE}
        drive["quadratic_drag"] *= values["coupling"]
        if self._cached and self._cached[0] == drive:
            return self._cached[1]
        model = Drive(**drive)
        responses = [
            respond(model, one.commands, one.ends, one.tick, one.samples, near)
            for (one, _), near in zip(self._passages, self._near, strict=True)
        ]
        moved = [forces for forces, _ in responses]
        if keep:
            self._cached, self._near = (drive, moved), [motion for _, motion in responses]
        return moved


def solve(
    problem: Problem, start: dict[str, float], rounds: int = 3, steps: int = 40
) -> dict[str, float]:
    """The likeliest values; `problem.noise` is what is likeliest with them.

    start: a value for each parameter; those that are not fitted keep it
    rounds: how often the noise is estimated anew, at most
    steps: of the least squares in each round, at most
    """
    values = start
    low, high = problem.bounds()
    problem.estimate_noise(problem.residuals(values))
    for turn in range(rounds):
        fixed = values

        def residual(z: Array, fixed: dict[str, float] = fixed) -> Array:
            return problem.whitened(problem.residuals(problem.to_values(z, fixed))).ravel()

        def jacobian(z: Array, fixed: dict[str, float] = fixed) -> Array:
            return problem.jacobian(problem.to_values(z, fixed)).reshape(-1, len(z))

        found = least_squares(
            residual,
            problem.to_z(values),
            jac=jacobian,
            bounds=(low, high),
            x_scale="jac",
            xtol=1e-6,
            ftol=1e-8,
            max_nfev=steps,
        )
        values = problem.to_values(found.x, fixed)
        before = problem.noise
        problem.estimate_noise(problem.residuals(values))
        if turn and all(
            abs(new.innovation / old.innovation - 1.0) < 1e-3
            for new, old in zip(problem.noise, before, strict=True)
        ):
            break
    return values


def _seen(values: dict[str, float], moved: Array) -> Array:
    """The forces of a response, as a sensor that is turned shows them; shape (2, windows)."""
    scale, inertia, drag = (values[n] for n in ("coupling", "thrust_coefficient", "lateral_drag"))
    fx = inertia * scale * scale * moved[0]
    fy = scale * (values["lateral_inertia_ratio"] * inertia * moved[1] + drag * moved[2])
    fy = fy + values["lateral_quadratic_drag"] * scale * scale * moved[4]
    fy = fy + values["servo_reaction"] * moved[3]
    cos, sin = np.cos(values["rotation"]), np.sin(values["rotation"])
    return np.stack((cos * fx - sin * fy, sin * fx + cos * fy))


def likeliest(residuals: Sequence[Array]) -> Noise:
    """The noise of one channel, by maximum likelihood over its passages."""
    count = sum(map(len, residuals))

    def noise(x: Array) -> Noise:
        # Gains of a steady Kalman filter: level in 0 … 1, slope up to level² / (2 − level).
        level = 1.0 / (1.0 + float(np.exp(-x[0])))
        share = 1.0 / (1.0 + float(np.exp(-x[1])))
        return Noise(1.0, level, share * level * level / (2.0 - level))

    def cost(x: Array) -> float:
        parts = [_innovations(part, noise(x)) for part in residuals]
        squares = sum(float(part @ part) for part, _ in parts)
        return count * float(np.log(squares)) + sum(lost for _, lost in parts)

    best = noise(minimize(cost, [-3.0, -1.0], method="Nelder-Mead", options={"xatol": 0.02}).x)
    squares = sum(float(np.sum(_innovations(part, best)[0] ** 2)) for part in residuals)
    return replace(best, innovation=float(np.sqrt(squares / count)))


def _innovations(residual: Array, noise: Noise) -> tuple[Array, float]:
    """A residual with its drift filtered out; level and slope at its start are projected out.

    Also what not knowing these two takes from the log-likelihood, twice.
    """
    filtered = lfilter(*_filter(noise), residual)
    basis, lost = _unknown_start(noise, len(residual))
    return filtered - basis @ (basis.T @ filtered), lost


def _filter(noise: Noise) -> tuple[list[float], list[float]]:
    """Numerator and denominator, in z⁻¹."""
    return [1.0, -2.0, 1.0], [1.0, noise.level + noise.slope - 2.0, 1.0 - noise.level]


@lru_cache(maxsize=64)
def _unknown_start(noise: Noise, count: int) -> tuple[Array, float]:
    """(count, 2), what the filter makes of any level and slope at the start, orthonormal."""
    _, denominator = _filter(noise)
    impulse = np.zeros(count)
    impulse[0] = 1.0
    columns = lfilter([1.0, -1.0], denominator, impulse), lfilter([0.0, 1.0], denominator, impulse)
    basis, triangle = np.linalg.qr(np.stack(columns, axis=1))
    return basis, 2.0 * float(np.log(np.abs(np.diag(triangle))).sum())
