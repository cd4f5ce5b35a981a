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
from typing import Annotated, Literal, get_args

from msgspec.structs import replace

from fishd.config import Config
from fishd.lab.simulation import simulate
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.base import REST, Plant, PlantParameters, PlantState, PlantWindow, unit
from fishd.virtual.plant.registry import PLANTS

STEP_S = 0.001
"""Longest step of the integration [s]."""
MODEL = "foreign"
Law = Literal["tanh", "linear", "accelerating", "square-root"]
LAWS: tuple[Law, ...] = get_args(Law)
HALF_BEATS = range(2, 26)
"""Half beats of the square waves among which the best one is [ticks]."""


class ForeignParameters(PlantParameters, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Parameters of the servo, in addition to the keys of every plant."""

    servo_law: Law = "linear"
    servo_acceleration: Annotated[float, unit("rad/s²", "Acceleration a.", gt=0.0)] = 100.0
    servo_asymmetry: Annotated[float, unit("1", "Share of Ω.", ge=-0.9, le=0.9)] = 0.0


class ForeignFish(Plant[ForeignParameters]):
    """Fish with one of these servos, integrated by steps of a millisecond."""

    Settings = ForeignParameters

    def __init__(self, parameters: ForeignParameters) -> None:
        super().__init__(parameters)
        self.state = REST
        self._wheel = self._rate = self._base = 0.0
        delay = round(parameters.servo_delay / STEP_S)
        self._commands = deque([0.0] * delay, maxlen=delay) if delay else None

    def advance(
        self, instruction_angle: float | None, duration: float, samples: int
    ) -> PlantWindow:
        """Implement `Plant.advance` by semi-implicit Euler steps."""
        p = self.parameters
        steps = 2 * math.ceil(0.5 * duration / samples / STEP_S)
        h = duration / samples / steps
        _, alpha, rate = self.state
        fx_sum = fy_sum = fx_sampled = fy_sampled = 0.0
        peak = abs(alpha)
        for step in range(samples * steps):
            command = self._wheel if instruction_angle is None else instruction_angle
            if self._commands is not None:
                oldest = self._commands[0]
                self._commands.append(command)
                command = oldest
            self._turn(command, h)
            half = 0.5 * p.backlash
            self._base = min(self._wheel + half, max(self._wheel - half, self._base))
            acceleration = (
                -p.xi * p.omega0 * rate
                - p.omega0**2 * (alpha - p.coupling * self._base)
                - p.quadratic_drag * rate * abs(rate)
            )
            rate += h * acceleration
            alpha += h * rate
            peak = max(peak, abs(alpha))
            fx = -p.thrust_coefficient * alpha * acceleration
            fy = -p.lateral_inertia * acceleration - p.lateral_drag * rate
            fx_sum += fx
            fy_sum += fy
            if step % steps == steps // 2:
                fx_sampled += fx
                fy_sampled += fy
        self.state = PlantState(self._wheel, alpha, rate)
        count = samples * steps
        return PlantWindow(
            duration, fx_sum / count, fy_sum / count, fx_sampled / samples, fy_sampled / samples,
            fin_peak=peak,
        )  # fmt: skip

    def _turn(self, command: float, h: float) -> None:
        """Turn the wheel for a time h [s]."""
        p = self.parameters
        error = command - self._wheel
        if abs(error) <= p.servo_dead_zone:
            error = 0.0
        direction = math.copysign(1.0, error)
        speed = p.servo_speed * (1.0 + direction * p.servo_asymmetry)
        if p.servo_law == "accelerating":
            wanted = direction * min(speed, math.sqrt(2.0 * p.servo_acceleration * abs(error)))
            change = p.servo_acceleration * h
            self._rate += min(change, max(-change, wanted - self._rate))
        else:
            lags = abs(error) / p.servo_lag
            share = {
                "tanh": math.tanh(lags),
                "linear": min(1.0, lags),
                "square-root": min(1.0, math.sqrt(lags)),
            }[p.servo_law]
            self._rate = direction * speed * share
        self._wheel += h * self._rate


def register() -> None:
    """Make this plant known to the present process, without a package and its entry point."""
    PLANTS._built_in[MODEL] = f"{__name__}:ForeignFish"  # type: ignore[index]


def foreign_fish(seed: int) -> Config:
    """Return a fish drawn by a seed, with a law of the servo in turn, and its rig."""
    register()
    chance = random.Random(seed)
    plain = PlantParameters()
    varied = {
        name: getattr(plain, name) * chance.uniform(0.7, 1.3)
        for name in ("omega0", "xi", "coupling", "servo_speed", "thrust_coefficient")
    }
    plant = ForeignParameters(
        model=MODEL,
        **varied,
        servo_law=LAWS[seed % len(LAWS)],
        servo_lag=chance.uniform(0.05, 0.3),
        servo_acceleration=chance.uniform(60.0, 300.0),
        servo_asymmetry=chance.choice((0.0, 0.0, chance.uniform(-0.2, 0.2))),
        servo_dead_zone=chance.choice((0.0, chance.uniform(0.0, 0.03))),
        backlash=chance.choice((0.0, chance.uniform(0.0, 0.05))),
        servo_delay=chance.uniform(0.0, 0.03),
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


def best_wave(config: Config) -> float:
    """Return the thrust of the best square wave whose half beats are whole ticks [N]."""
    still = replace(config, simulation=SimulationSettings())
    frequencies = [0.5 / (ticks * config.tick) for ticks in HALF_BEATS]
    return max(simulate(still, "square", {"frequency": f}, 30.0).mean_thrust for f in frequencies)
