"""Fish whose servo follows another law than that of fishd's model, for benches of `adapt`.

With the wheel's angle φ behind a delay, and the fin's base ψ behind a play of width b:

    linear:        φ̇ = Ω e/Δ, at most Ω       e = φ_c − φ, or 0 within the dead zone
    square-root:   φ̇ = Ω √(|e|/Δ) sgn e, at most Ω
    accelerating:  φ̈ = ±a towards √(2a|e|) sgn e, at most Ω
    tanh:          φ̇ = Ω tanh(e/Δ)
    α̈ = −ξω₀ α̇ − ω₀² (α − λψ) − c α̇|α̇|,  F_x = −K α α̈,  F_y = −K_y α̈ − K_d α̇

Ω is larger in one direction by a share of asymmetry, and smaller in the other.
"""

import math
import random
from collections import deque
from functools import lru_cache, partial
from typing import Annotated

import numpy as np
from msgspec.structs import asdict
from scipy.linalg import expm

from fishd.config import Config
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.base import REST, Plant, PlantParameters, PlantState, PlantWindow, unit
from fishd.virtual.plant.registry import PLANTS
from fishd.virtual.plant.servo_law import LAWS

STEP_S = 0.001
"""Longest step of the integration of the fin [s]."""
WHEEL_STEPS = 8
"""Number of steps of the wheel in one of the fin."""
MODEL = "foreign"
VARIED = "omega0", "xi", "coupling", "servo_speed", "thrust_coefficient", "lateral_drag"
"""Parameters up to 30 % from those of the default fish."""
FOREIGN_KINDS = (
    *LAWS, "backlash", "dead zone", "delay", "asymmetry", "backlash and dead zone", "all of these",
    "quadratic drag", "K_y/K from 0.25 to 0.5", "K_y/K from 2 to 4", "all, K_y/K from 2 to 4",
)  # fmt: skip
"""Kinds of foreign fish, in turn; those that are not named after a law have each in turn."""


class ForeignParameters(PlantParameters, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the servo, in addition to the keys of every plant."""

    servo_acceleration: Annotated[float, unit("rad/s²", "Acceleration a.", gt=0.0)] = 100.0
    servo_asymmetry: Annotated[float, unit("1", "Share of Ω.", ge=-0.9, le=0.9)] = 0.0


class ForeignFish(Plant[ForeignParameters]):
    """Fish with one of these servos: its wheel moves by short steps, its fin exactly between them.

    The wheel, quadratic drag and the mean of F_x have errors of second order in the steps.
    """

    Settings = ForeignParameters

    def __init__(self, parameters: ForeignParameters) -> None:
        super().__init__(parameters)
        self.state = REST
        self._wheel = self._rate = self._base = self._thrust = 0.0
        self._command: float | None = None
        self._delayed: deque[tuple[float, float | None]] = deque()
        """Times until arrival [s], and commands that the servo has then [rad]."""
        self._fin = lru_cache(partial(_fin_motion, parameters))

    def advance(
        self, instruction_angle: float | None, duration: float, samples: int
    ) -> PlantWindow:
        """Implement `Plant.advance` by steps of a millisecond."""
        p = self.parameters
        steps = 2 * math.ceil(0.5 * duration / samples / STEP_S)
        count = samples * steps
        h = duration / count
        (f11, f12, a1, a2), (f21, f22, v1, v2) = self._fin(h)
        _, alpha, rate = start = self.state
        self._delayed.append((p.servo_delay, instruction_angle))
        thrusts, accelerations, rates, peak = [], [], [], abs(alpha)
        for _ in range(count):
            before, after = self._base, self._move_base(h)
            rate /= 1.0 + 0.5 * h * p.quadratic_drag * abs(rate)
            alpha, rate = (
                f11 * alpha + f12 * rate + a1 * before + a2 * after,
                f21 * alpha + f22 * rate + v1 * before + v2 * after,
            )
            rate /= 1.0 + 0.5 * h * p.quadratic_drag * abs(rate)
            acceleration = (
                -p.xi * p.omega0 * rate
                - p.omega0**2 * (alpha - p.coupling * after)
                - p.quadratic_drag * rate * abs(rate)
            )
            peak = max(peak, abs(alpha))
            rates.append(rate)
            accelerations.append(acceleration)
            thrusts.append(-p.thrust_coefficient * alpha * acceleration)
        first, self._thrust = self._thrust, thrusts[-1]
        self.state = PlantState(self._wheel, alpha, rate)
        middles = slice(steps // 2 - 1, None, steps)
        inertia, drag = p.lateral_inertia, p.lateral_drag
        return PlantWindow(
            duration,
            (sum(thrusts) + 0.5 * (first - thrusts[-1])) / count,
            -(inertia * (rate - start.alpha_rate) + drag * (alpha - start.alpha)) / duration,
            sum(thrusts[middles]) / samples,
            -(inertia * sum(accelerations[middles]) + drag * sum(rates[middles])) / samples,
            fin_peak=peak,
        )

    def _move_base(self, duration: float) -> float:
        """Turn the wheel for a time [s]; return the angle of the fin's base behind its play."""
        while self._delayed and self._delayed[0][0] < duration:
            arrival, command = self._delayed[0]
            self._turn(arrival)
            duration -= arrival
            self._command = command
            self._delayed.popleft()
        self._turn(duration)
        half = 0.5 * self.parameters.backlash
        self._base = min(self._wheel + half, max(self._wheel - half, self._base))
        return self._base

    def _turn(self, duration: float) -> None:
        """Turn the wheel towards the present command for a time [s]."""
        self._delayed = deque((time - duration, later) for time, later in self._delayed)
        if self._command is None or duration <= 0.0:
            return
        p = self.parameters
        h = duration / WHEEL_STEPS
        for _ in range(WHEEL_STEPS):
            error = self._command - self._wheel
            if p.servo_law == "accelerating":
                change = p.servo_acceleration * h
                if abs(error) <= change * h and abs(self._rate) <= change:
                    self._wheel, self._rate = self._command, 0.0
                    continue
                rate = self._braking_rate(error, h)
                rate = min(self._rate + change, max(self._rate - change, rate))
                self._wheel += 0.5 * h * (self._rate + rate)
                self._rate = rate
            else:
                halfway = error - 0.5 * h * self._wanted_rate(error)
                most = max(0.0, abs(error) - p.servo_dead_zone)
                self._wheel += min(most, max(-most, h * self._wanted_rate(halfway)))

    def _wanted_rate(self, error: float) -> float:
        """Return the speed of the wheel at a distance from its command [rad/s]."""
        p = self.parameters
        direction = math.copysign(1.0, error)
        speed = direction * p.servo_speed * (1.0 + direction * p.servo_asymmetry)
        error, lags = abs(error), abs(error) / p.servo_lag
        if error <= p.servo_dead_zone:
            return 0.0
        if p.servo_law == "tanh":
            return speed * math.tanh(lags)
        if p.servo_law == "linear":
            return speed * min(1.0, lags)
        return speed * min(1.0, math.sqrt(lags))

    def _braking_rate(self, error: float, h: float) -> float:
        """Return the rate after a step from which an accelerating wheel can just stop [rad/s]."""
        p = self.parameters
        if abs(error) <= p.servo_dead_zone:
            return 0.0
        direction = math.copysign(1.0, error)
        change = p.servo_acceleration * h
        left = 2.0 * p.servo_acceleration * abs(error) - change * self._rate * direction
        rate = math.sqrt(max(0.0, 0.25 * change * change + left)) - 0.5 * change
        return direction * min(p.servo_speed * (1.0 + direction * p.servo_asymmetry), rate)


def _fin_motion(p: ForeignParameters, h: float) -> list[list[float]]:
    """Return the matrix from [α, α̇, λψ before, λψ after] to [α, α̇] a time h [s] later."""
    fin = np.array(
        [[0.0, 1.0, 0.0, 0.0], [-(p.omega0**2), -p.xi * p.omega0, p.omega0**2 * p.coupling, 0.0],
         [0.0, 0.0, 0.0, 1.0 / h], [0.0, 0.0, 0.0, 0.0]]
    )  # fmt: skip
    moved = expm(fin * h)  # the last state is the change of ψ during the step
    moved[:, 2] -= moved[:, 3]
    matrix: list[list[float]] = moved[:2].tolist()
    return matrix


def register() -> None:
    """Make this plant known to the present process, without a package and its entry point."""
    PLANTS._built_in[MODEL] = f"{__name__}:ForeignFish"  # type: ignore[index]


def foreign_fish(seed: int) -> Config:
    """Return a fish of one of `FOREIGN_KINDS`, and its rig."""
    register()
    turn, place = divmod(seed % 1000, len(FOREIGN_KINDS))
    kind = FOREIGN_KINDS[place]
    chance = random.Random(seed)
    plain = asdict(PlantParameters())
    has_all = kind.startswith("all")
    ratio = chance.uniform(2.0, 4.0)
    varied = {name: plain[name] * chance.uniform(0.7, 1.3) for name in VARIED}
    imperfections = {
        "servo_asymmetry": (
            "asymmetry" in kind,
            chance.choice((-1, 1)) * chance.uniform(0.05, 0.2),
        ),
        "servo_dead_zone": ("dead zone" in kind, chance.uniform(0.01, 0.03)),
        "backlash": ("backlash" in kind, chance.uniform(0.01, 0.05)),
        "servo_delay": (kind == "delay", chance.uniform(0.005, 0.03)),
    }
    drag = chance.uniform(0.5, 2.0)
    ratios = {"K_y/K from 0.25 to 0.5": 1.0 / ratio}
    plant = ForeignParameters(
        model=MODEL,
        **varied,
        servo_law=kind if kind in LAWS else LAWS[(seed % 1000 + turn) % len(LAWS)],
        servo_lag=chance.uniform(0.05, 0.3),
        servo_acceleration=chance.uniform(60.0, 300.0),
        **{name: value for name, (is_on, value) in imperfections.items() if is_on or has_all},
        quadratic_drag=drag if kind == "quadratic drag" else 0.0,
        lateral_inertia_ratio=ratios.get(kind, ratio if "from 2 to 4" in kind else 1.0),
    )
    rig = SimulationSettings(
        noise=1e-3 * chance.uniform(0.5, 2.0),
        rotation=math.radians(chance.uniform(-5.0, 5.0)),
        offset_x=chance.uniform(-0.02, 0.02),
        offset_y=chance.uniform(-0.02, 0.02),
        drift=5e-3 * chance.random(),
        seed=seed,
    )
    return Config(plant=plant, simulation=rig)
