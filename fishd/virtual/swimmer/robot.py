"""Free swimmer behind the protocols of real hardware: a sensor, a servo, and its true state.

It advances at each read, by the time since the previous read, with the activation a = φ_c/Φ, either
at once or with the delay of the servo's wheel. It does not use a clock.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from fishd.core.errors import FishLost
from fishd.core.signals import Course, Measurement, Truth
from fishd.hardware.base import Robot
from fishd.virtual.plant.base import TrueWindow
from fishd.virtual.plant.drive_train import relax
from fishd.virtual.plant.parameters import PlantParameters
from fishd.virtual.swimmer.fish import (
    FRONT_FRACTION,
    TAIL_FRACTION,
    Diverged,
    Fish,
    Motion,
    Work,
)
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.settings import SwimmerSettings


class Window(NamedTuple):
    """True values between two reads; forces are those of the water on a fish one metre deep."""

    duration: float
    """Length of the window [s]."""
    thrust: float
    """Mean force along −x [N]."""
    side_force: float
    """Mean force along y [N]."""
    tail_peak: float
    """Largest angle of the tail to the front body [rad]."""


class Swimmer:
    """Force sensor, tail sensor and muscles of a free swimmer."""

    def __init__(
        self,
        settings: SwimmerSettings,
        plant: PlantParameters,
        amplitude: float,
        tick: float,
        *,
        senses_tail: bool = False,
    ) -> None:
        """settings: as accepted by `feasibility.check`

        plant: parameters of the servo, if the muscles follow one
        amplitude: Φ, the instruction angle of full activation [rad]
        tick: period of the loop, a whole number of steps; the first read covers one period [s]
        senses_tail: whether the measured fin velocity is that of the tail across the laboratory,
            over its distance to the middle of the front body, and not `Motion.tail_rate`
        """
        self.settings = settings
        self.fish = Fish(settings)
        self.amplitude = amplitude
        self.trouble: Diverged | None = None
        """Error that has ended the simulation."""
        self.motion = self.fish.motion()
        """Motion at the latest read."""
        self.tail_reach = (self.motion.tail_y, self.motion.tail_y)
        """Smallest and largest y of the tip of the tail between the latest two reads [m]."""
        self.window = Window(tick, 0.0, 0.0, 0.0)
        """True values between the latest two reads; zero before the first."""
        self._plant = plant
        self._tick = tick
        self._start: float | None = None
        self._steps = 0
        self._instruction_angle: float | None = None
        self._phi = 0.0
        self._sensed_rate = 0.0
        lever = (TAIL_FRACTION - 0.5 * FRONT_FRACTION) * settings.body.length
        self._lever = lever if senses_tail else None
        smoothing = settings.sensor_time / settings.numerics.step
        self._share = -math.expm1(-1.0 / smoothing) if smoothing else 1.0

    def compile(self) -> None:
        """Run one step, which compiles the functions, and restore the state."""
        state = self.fish.state()
        self.fish.step(0.0)
        self.fish.restore(state)

    def read(self, now: float) -> Measurement:
        """Advance to `now` [s]; return mean forces on a fish one metre deep.

        Raises `FishLost` where the simulation has diverged, now or earlier.
        """
        if self.trouble:
            raise FishLost(str(self.trouble))
        if self._start is None:
            self._start = now - self._tick
        step_count = max(1, round((now - self._start) / self.fish.dt) - self._steps)
        self._steps += step_count
        thrust = side_force = peak = 0.0
        lowest, highest = math.inf, -math.inf
        for _ in range(step_count):
            motion = self._advance()
            thrust += motion.thrust
            side_force += motion.side_force
            peak = max(peak, abs(motion.tail_angle))
            lowest, highest = min(lowest, motion.tail_y), max(highest, motion.tail_y)
        self.motion, self.tail_reach = motion, (lowest, highest)
        self.window = Window(
            step_count * self.fish.dt, thrust / step_count, side_force / step_count, peak
        )
        return Measurement(
            time=now,
            fx=thrust / step_count,
            fy=side_force / step_count,
            samples=step_count,
            fin_velocity=self._sensed_rate,
            mean_time=now - 0.5 * self.window.duration,
            span=self.window.duration,
        )

    def _advance(self) -> Motion:
        """Advance the fish by one step, and return its motion."""
        try:
            self.fish.step(self._activation())
        except Diverged as error:
            self.trouble = error
            raise FishLost(str(error)) from error
        motion = self.fish.motion()
        rate = motion.tail_speed / self._lever if self._lever else motion.tail_rate
        self._sensed_rate += self._share * (rate - self._sensed_rate)
        return motion

    def _activation(self) -> float:
        """Return the activation of the next step; without pulses the muscles are relaxed."""
        if self._instruction_angle is None:
            self._phi = 0.0
        elif not self.settings.muscle.servo:
            self._phi = self._instruction_angle
        else:  # value in the middle of the step
            middle = self._wheel_after(self._phi, 0.5 * self.fish.dt)
            self._phi = self._wheel_after(self._phi, self.fish.dt)
            return middle / self.amplitude
        return self._phi / self.amplitude

    def _wheel_after(self, phi: float, duration: float) -> float:
        """Return the angle of the wheel at `phi` after `duration` s [rad]."""
        plant, angle = self._plant, self._instruction_angle or 0.0
        lag = (angle - phi) / plant.servo_lag
        return angle - plant.servo_lag * relax(lag, duration * plant.servo_speed / plant.servo_lag)

    def take_window(self) -> TrueWindow:
        """Return the values of `window` that all robots have."""
        return TrueWindow(self.window.duration, self.window.thrust, self.window.tail_peak)

    @property
    def work(self) -> Work:
        """Work since the start, of a fish one metre deep [J]."""
        return self.fish.work

    @property
    def instruction_angle(self) -> float:
        """Current instruction angle; 0 where the muscles are relaxed [rad]."""
        return self._instruction_angle or 0.0

    def write(self, instruction_angle: float) -> None:
        """Set the instruction angle [rad] from the latest read onwards."""
        self._instruction_angle = instruction_angle

    def release(self) -> None:
        """Relax the muscles."""
        self._instruction_angle = None

    def close(self) -> None:
        """Relax the muscles."""
        self.release()

    def truth(self) -> Truth:
        """Return the true state at the latest read; the tail angle refers to the front body."""
        motion = self.motion
        return Truth(
            alpha=motion.tail_angle,
            alpha_rate=motion.tail_rate,
            phi=self.fish.activation * self.amplitude,
            course=Course(motion.x, motion.y, motion.speed, motion.heading),
        )

    def limitations(self) -> tuple[str, ...]:
        """Return why the simulation has ended, if it has."""
        return (f"{self.trouble}; restart fishd",) if self.trouble else ()

    def robot(self) -> Robot:
        """Return the robot of the loop."""
        return Robot("swimmer", self, self, truth=self.truth, limitations=self.limitations)

    def state(self) -> dict[str, Array]:
        """Return the complete state by name."""
        angle = math.nan if self._instruction_angle is None else self._instruction_angle
        return self.fish.state() | {"robot": np.array([angle, self._phi, self._sensed_rate])}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore a result of `state` exactly."""
        self.fish.restore(state)
        angle, self._phi, self._sensed_rate = map(float, state["robot"])
        self._instruction_angle = None if math.isnan(angle) else angle
        self.motion = self.fish.motion()
        self.tail_reach = (self.motion.tail_y, self.motion.tail_y)
