"""The free swimmer behind the protocols of real hardware: a sensor, a servo, and its truth.

It advances when it is read, by the time since the previous read, with the activation that the
instruction angle asks for: a = φ_c/Φ, at once or as the servo's wheel follows. So it knows no
clock.
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
from fishd.virtual.swimmer.fish import Diverged, Fish, Motion, Work
from fishd.virtual.swimmer.grid import Array
from fishd.virtual.swimmer.settings import SwimmerSettings


class Window(NamedTuple):
    """What truly happened between two reads; forces are of the water, on a fish one metre deep."""

    duration: float
    """[s]"""
    thrust: float
    """Mean force along −x [N]."""
    side_force: float
    """Mean force along y [N]."""
    tail_peak: float
    """Largest angle of the tail against the front body [rad]."""


class Swimmer:
    """A force sensor, a sensor of the tail, and muscles, with a free swimmer between them."""

    def __init__(
        self, settings: SwimmerSettings, plant: PlantParameters, amplitude: float, tick: float
    ) -> None:
        """Settings that `feasibility.check` accepts.

        plant: of which the servo counts, where the muscles follow one
        amplitude: Φ, the instruction angle of full activation [rad]
        tick: period of the loop, a whole number of steps; the first read covers one [s]
        """
        self.settings = settings
        self.fish = Fish(settings)
        self.amplitude = amplitude
        self.trouble: Diverged | None = None
        """Why it cannot go on."""
        self.motion = self.fish.motion()
        """At the latest read."""
        self.tail_reach = (self.motion.tail_y, self.motion.tail_y)
        """Least and greatest y of the tip of the tail between the latest two reads [m]."""
        self.window = Window(tick, 0.0, 0.0, 0.0)
        """What truly happened between the latest two reads; nothing before the first."""
        self._plant = plant
        self._tick = tick
        self._start: float | None = None
        self._steps = 0
        self._angle: float | None = None
        self._phi = 0.0
        self._sensed_rate = 0.0
        smoothing = settings.sensor_time / settings.numerics.step
        self._share = -math.expm1(-1.0 / smoothing) if smoothing else 1.0

    def compile(self) -> None:
        """Do what takes long when it is done for the first time, as in the first step."""
        state = self.fish.state()
        self.fish.step(0.0)
        self.fish.restore(state)

    def read(self, now: float) -> Measurement:
        """Swim until `now` [s]; forces are means over the way, on a fish one metre deep.

        Raises `FishLost` where the fish cannot go on, then and ever after.
        """
        if self.trouble:
            raise FishLost(str(self.trouble))
        if self._start is None:
            self._start = now - self._tick
        due = max(1, round((now - self._start) / self.fish.dt) - self._steps)
        self._steps += due
        thrust = side = peak = 0.0
        lowest, highest = math.inf, -math.inf
        for _ in range(due):
            motion = self._advance()
            thrust += motion.thrust
            side += motion.side_force
            peak = max(peak, abs(motion.tail_angle))
            lowest, highest = min(lowest, motion.tail_y), max(highest, motion.tail_y)
        self.motion, self.tail_reach = motion, (lowest, highest)
        self.window = Window(due * self.fish.dt, thrust / due, side / due, peak)
        return Measurement(
            time=now,
            fx=thrust / due,
            fy=side / due,
            samples=due,
            fin_velocity=self._sensed_rate,
        )

    def _advance(self) -> Motion:
        """One step of the fish."""
        try:
            self.fish.step(self._activation())
        except Diverged as error:
            self.trouble = error
            raise FishLost(str(error)) from error
        motion = self.fish.motion()
        self._sensed_rate += self._share * (motion.tail_rate - self._sensed_rate)
        return motion

    def _activation(self) -> float:
        """In the next step; without pulses the muscles are relaxed."""
        if self._angle is None:
            self._phi = 0.0
        elif not self.settings.muscle.servo:
            self._phi = self._angle
        else:  # as in the middle of the step
            middle = self._followed(self._phi, 0.5 * self.fish.dt)
            self._phi = self._followed(self._phi, self.fish.dt)
            return middle / self.amplitude
        return self._phi / self.amplitude

    def _followed(self, phi: float, duration: float) -> float:
        """Where the wheel at `phi` is after `duration` s [rad]."""
        plant, angle = self._plant, self._angle or 0.0
        lag = (angle - phi) / plant.servo_lag
        return angle - plant.servo_lag * relax(lag, duration * plant.servo_speed / plant.servo_lag)

    def take_window(self) -> TrueWindow:
        """The same for those who judge runs of every robot."""
        return TrueWindow(self.window.duration, self.window.thrust, self.window.tail_peak)

    @property
    def work(self) -> Work:
        """What was done since the start, by a fish one metre deep [J]."""
        return self.fish.work

    @property
    def command(self) -> float:
        """The instruction angle now; 0 where the muscles are relaxed [rad]."""
        return self._angle or 0.0

    def write(self, angle: float) -> None:
        """Set the instruction angle [rad] from the latest read onwards."""
        self._angle = angle

    def release(self) -> None:
        """Let the muscles relax."""
        self._angle = None

    def close(self) -> None:
        """The same."""
        self.release()

    def truth(self) -> Truth:
        """The true state at the latest read; the tail is that against the front body."""
        motion = self.motion
        return Truth(
            alpha=motion.tail_angle,
            alpha_rate=motion.tail_rate,
            phi=self.fish.activation * self.amplitude,
            course=Course(motion.x, motion.y, motion.speed, motion.heading),
        )

    def degraded(self) -> tuple[str, ...]:
        """Why it does not swim any more, where it does not."""
        return (f"{self.trouble}; restart fishd",) if self.trouble else ()

    def robot(self) -> Robot:
        """This fish as the loop sees it."""
        return Robot("swimmer", self, self, truth=self.truth, degraded=self.degraded)

    def state(self) -> dict[str, Array]:
        """Everything that the next read depends on, by name."""
        angle = math.nan if self._angle is None else self._angle
        return self.fish.state() | {"robot": np.array([angle, self._phi, self._sensed_rate])}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what `state` gave, to the last bit."""
        self.fish.restore(state)
        angle, self._phi, self._sensed_rate = map(float, state["robot"])
        self._angle = None if math.isnan(angle) else angle
        self.motion = self.fish.motion()
        self.tail_reach = (self.motion.tail_y, self.motion.tail_y)
