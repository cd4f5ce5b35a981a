"""The free swimmer: a body that bends itself in still water, a step at a time."""

import math
from typing import NamedTuple

import numpy as np

from fishd.core.errors import FishdError
from fishd.swimmer.feasibility import build_beam, curvature
from fishd.swimmer.flow import Flow
from fishd.swimmer.grid import Array, Grid, edges
from fishd.swimmer.immersed import Immersed, LeftTheGrid
from fishd.swimmer.settings import SwimmerSettings

FRONT = 0.4
"""The front body: this share of the length, which hardly bends; heading and tail refer to it."""
REAR = 0.8
"""The rear body begins here. Its middle is what the angle of the tail is told of: the tip, which is
thin, flutters."""
FOLLOW_TIME = 0.05
"""The grid takes on the speed of the fish with this time constant [s]."""
RECENTRE = 2.0
"""So much of the way back to the middle of the grid in a second [1/s]."""
UNSTABLE = 1.0
"""A Courant number beyond which nothing that is computed is to be believed."""
_CHECKED_EVERY = 20
_STEER_TIME = 0.4
"""Heading and place are averaged over about so long before the fish is steered [s]."""
_STEER_RATE = 4.0
_STEER_REACH = 5.0


class Diverged(FishdError):
    """The computation cannot go on; the message says when and why."""


class Motion(NamedTuple):
    """How the fish moves at an instant; it swims towards −x, and y is to the right of it."""

    time: float
    """[s]"""
    x: float
    """Centre of mass in the laboratory [m]."""
    y: float
    """[m]"""
    speed: float
    """Forwards: along −x [m/s]."""
    sideways: float
    """Along y [m/s]."""
    heading: float
    """Of the front body against −x [rad]."""
    tail_angle: float
    """Of the rear body, seen from the middle of the front body [rad]."""
    tail_rate: float
    """Its rate [rad/s]."""
    deflection: float
    """Of the tip of the tail from the axis of the front body [m]."""
    tail_y: float
    """Of the tip of the tail, in the laboratory [m]."""
    thrust: float
    """Force of the water on the body along −x, per metre of depth [N]."""
    side_force: float
    """Force of the water on the body along y, per metre of depth [N]."""


class Work(NamedTuple):
    """What was done since the start, per metre of depth [J]."""

    muscles: float
    """By the muscles: on the body, and through it on the water."""
    water: float
    """By the body on the water."""
    forwards: float
    """By those slices that pushed the fish forwards."""
    sideways: float
    """By the body on the water across the swimming direction."""


class Fish:
    """A fish in its tank; `step` moves it by `settings.numerics.step`."""

    def __init__(self, settings: SwimmerSettings) -> None:
        """Settings that `feasibility.check` accepts."""
        self.settings = settings
        body, water, numerics = settings.body, settings.water, settings.numerics
        self.dt = numerics.step
        self.beam = build_beam(settings)
        self.beam.q[0] = -0.5 * body.length
        length, width = numerics.fine_length * body.length, numerics.fine_width * body.length
        grid = Grid(
            edges(
                -0.5 * water.length,
                0.5 * water.length,
                (-0.5 * length, 0.5 * length),
                numerics.cell,
                numerics.stretch_along,
            ),
            edges(
                -0.5 * water.width,
                0.5 * water.width,
                (-0.5 * width, 0.5 * width),
                numerics.cell,
                numerics.stretch_across,
            ),
        )
        self.flow = Flow(grid, water.viscosity, "slip")
        self.body = Immersed(self.flow, water.density, self.beam)
        self.activation = 0.0
        """a, from −1 to 1, during the latest step."""
        self._steps = 0
        self._travelled = 0.0
        self._drive = self.beam.drive(lambda X: curvature(settings, X))
        self._couple = self.beam.couple()
        self._inertia = water.density * (
            self.beam.area * body.length**2 / 12.0 + math.pi * (0.5 * body.length) ** 4 / 8.0
        )
        self._sensed_heading = self._sensed_y = 0.0
        self._work = np.zeros(4)
        self._hydrodynamic = np.zeros((self.beam.slices, 2))
        self._front = self.beam.share * (FRONT * body.length > self.beam.X)
        self._front /= self._front.sum()
        self._rear = self.beam.share * (REAR * body.length < self.beam.X)
        self._rear /= self._rear.sum()

    @property
    def time(self) -> float:
        """Since the start [s]."""
        return self._steps * self.dt

    @property
    def work(self) -> Work:
        """Since the start [J]."""
        return Work(*map(float, self._work))

    def step(self, activation: float) -> None:
        """Go on by one step with the activation a, cut to −1 … 1.

        Raises `Diverged` where what comes out cannot be a fish that swims.
        """
        self.activation = min(1.0, max(-1.0, activation))
        beam, body, dt = self.beam, self.body, self.dt
        forces = self.activation * self._drive + self._steer() * self._couple
        before = body.velocity
        try:
            body.step(dt, forces)
        except LeftTheGrid as error:
            raise self._diverged(f"{error}; swimmer.steering keeps it there") from None
        except np.linalg.LinAlgError:
            raise self._diverged("the motion of the body has no solution") from None
        self._steps += 1
        self._account(before)
        speed = float(beam.share @ body.velocity[:, 0])
        place = float(beam.share @ beam.shape(beam.q)[0][:, 0])
        self._travelled += dt * self.flow.grid_velocity
        wanted = speed + RECENTRE * place
        self.flow.grid_velocity += dt / FOLLOW_TIME * (wanted - self.flow.grid_velocity)
        if self._steps % _CHECKED_EVERY == 0:
            courant = self.flow.courant_number(dt)
            if not courant < UNSTABLE:
                raise self._diverged(
                    f"the water passes {courant:.2g} cells in a step; a shorter "
                    "swimmer.numerics.step may help"
                )

    def _diverged(self, why: str) -> Diverged:
        return Diverged(f"the swimmer cannot go on at {self.time:.3f} s: {why}")

    def _steer(self) -> float:
        """A torque that turns the fish back to the middle, without any net force [N m]."""
        gain = self.settings.steering
        if not gain:
            return 0.0
        places, angle = self.beam.shape(self.beam.q)
        share = self.dt / _STEER_TIME
        turning = float(self.beam.share @ self.body.velocity[:, 2])
        self._sensed_heading += share * (float(self.beam.share @ angle) - self._sensed_heading)
        self._sensed_y += share * (float(self.beam.share @ places[:, 1]) - self._sensed_y)
        wanted = _STEER_REACH * self._sensed_y
        wanted = min(0.3, max(-0.3, wanted))
        pull = _STEER_RATE * (wanted - self._sensed_heading) - turning
        return gain * _STEER_RATE * self._inertia * pull

    def _account(self, before: Array) -> None:
        """Add up the work of the latest step; before: velocities of the slices before it."""
        body, beam, dt = self.body, self.beam, self.dt
        velocity = body.velocity
        change = (body.mass @ (velocity - before)[:, :, None])[:, :, 0] / dt
        water = change - body.force  # of the water around on each slice
        self._hydrodynamic = water[:, :2]
        speed = -float(beam.share @ velocity[:, 0])
        self._work += dt * np.array(
            [
                self.activation * float(self._drive @ beam.rate),
                -float(np.sum(water * velocity)),
                float(np.maximum(-water[:, 0], 0.0).sum()) * speed,
                -float(water[:, 1] @ velocity[:, 1]),
            ]
        )

    def motion(self) -> Motion:
        """How it moves now."""
        beam, velocity = self.beam, self.body.velocity
        places, angle = beam.shape(beam.q)
        centre, mean = beam.share @ places, beam.share @ velocity
        front, front_rate = self._front @ places, self._front @ velocity
        heading = float(self._front @ angle)
        across = np.array([-math.sin(heading), math.cos(heading)])
        along = np.array([math.cos(heading), math.sin(heading)])
        arm = self._rear @ places - front
        off, reach = float(arm @ across), float(arm @ along)
        relative = (self._rear @ velocity - front_rate)[:2]
        off_rate = float(relative @ across) - front_rate[2] * reach
        reach_rate = float(relative @ along) + front_rate[2] * off
        return Motion(
            time=self.time,
            x=self._travelled + float(centre[0]),
            y=float(centre[1]),
            speed=-float(mean[0]),
            sideways=float(mean[1]),
            heading=heading,
            tail_angle=math.atan2(off, reach),
            tail_rate=float(off_rate * reach - reach_rate * off) / (reach**2 + off**2),
            deflection=float((places[-1] - front) @ across),
            tail_y=float(places[-1, 1]),
            thrust=-float(self._hydrodynamic[:, 0].sum()),
            side_force=float(self._hydrodynamic[:, 1].sum()),
        )

    def outline(self) -> Array:
        """The surface of the body on the grid, shape (2 slices, 2) [m]."""
        places, angle = self.beam.shape(self.beam.q)
        normal = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
        offset = self.beam.half_thickness[:, None] * normal
        return np.concatenate([places + offset, (places - offset)[::-1]])

    def midline(self) -> Array:
        """Places of the slices on the grid, shape (slices, 2) [m]."""
        return self.beam.shape(self.beam.q)[0]

    @property
    def travelled(self) -> float:
        """How far the grid went along x, in the laboratory [m]."""
        return self._travelled

    def state(self) -> dict[str, Array]:
        """Everything that the next step depends on, by name."""
        return self.body.state() | {
            "steps": np.array(self._steps),
            "travelled": np.array(self._travelled),
            "activation": np.array(self.activation),
            "sensed": np.array([self._sensed_heading, self._sensed_y]),
            "work": self._work.copy(),
            "hydrodynamic": self._hydrodynamic.copy(),
        }

    def restore(self, state: dict[str, Array]) -> None:
        """Go on from what `state` gave, to the last bit."""
        self.body.restore(state)
        self._steps = int(state["steps"])
        self._travelled = float(state["travelled"])
        self.activation = float(state["activation"])
        self._sensed_heading, self._sensed_y = map(float, state["sensed"])
        self._work, self._hydrodynamic = state["work"].copy(), state["hydrodynamic"].copy()
