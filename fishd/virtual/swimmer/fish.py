"""The free swimmer: a body that bends itself in still water, a step at a time."""

import math
from typing import NamedTuple

import numpy as np

from fishd.core.errors import FishdError
from fishd.virtual.swimmer.body import build_beam, curvature
from fishd.virtual.swimmer.flow import Flow
from fishd.virtual.swimmer.grid import Array, Grid, edges
from fishd.virtual.swimmer.immersed import Immersed, LeftTheGrid
from fishd.virtual.swimmer.settings import SwimmerSettings

FRONT = 0.4
"""The front body: this share of the length, which hardly bends; heading and tail refer to it."""
REAR = 0.8
"""The rear body begins here. The angle of the tail is that of its middle: the tip, which is thin,
flutters."""
FOLLOW_TIME = 0.05
"""The grid takes on the speed of the fish with this time constant [s]."""
RECENTRE = 2.0
"""So much of the way back to the middle of the grid in a second [1/s]."""
UNSTABLE = 1.0
"""A Courant number beyond which nothing that is computed is to be believed."""
_FASTEST = 0.05
"""No body moves by so many of its lengths in a step."""
_CHECKED_EVERY = 20
_STEER_TIME = 0.4
"""Heading and place are averaged over about so long, for how the fish is steered [s]."""
_STEER_RATE = 2.0
"""So fast the heading is corrected [1/s]; below 1/_STEER_TIME, or a gliding fish would swing."""
_STEER_REACH = 10.0
"""Heading that is wanted for each metre off the middle [rad/m], and the largest one [rad]."""
_STEER_MOST = 0.3


class Diverged(FishdError):
    """The computation cannot go on; the message says when and why."""


class Motion(NamedTuple):
    """How the fish moves at an instant; it swims towards −x, and y is to the right of it.

    Forces are those on a body one metre deep.
    """

    time: float
    """[s]"""
    x: float
    """Centre of mass in the laboratory [m]."""
    y: float
    """[m]"""
    speed: float
    """Forwards: along −x [m/s]."""
    heading: float
    """Of the front body against −x [rad]."""
    tail_angle: float
    """Of the rear body, seen from the middle of the front body [rad]."""
    tail_rate: float
    """Its rate [rad/s]."""
    tail_y: float
    """Of the tip of the tail, in the laboratory [m]."""
    thrust: float
    """Force of the water on the body along −x [N]."""
    side_force: float
    """Force of the water on the body along y [N]."""


class Work(NamedTuple):
    """What was done since the start, by a body one metre deep [J]."""

    muscles: float
    """By the muscles: on the body, and through it on the water; less what they take up while
    stretched."""
    water: float
    """By the body on the water."""
    forwards: float
    """By those slices that pushed the fish forwards: their force times its speed, at each
    instant."""
    sideways: float
    """By the body on the water across the swimming direction."""
    steering: float
    """By the torque that keeps the fish on the middle; negative where it brakes."""


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
        # Of a rod as long and heavy as the fish, and of the water that a plate as long turns with
        # it, π/8 ρ (L/2)⁴ (Newman, Marine Hydrodynamics, 1977, table 4.3) [kg m²/m].
        self._inertia = water.density * (
            self.beam.area * body.length**2 / 12.0 + math.pi / 8.0 * (0.5 * body.length) ** 4
        )
        self._averaged_heading = self._averaged_y = 0.0
        self._torque = 0.0
        self._work = np.zeros(5)
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
        self._torque = self._steer()
        forces = self.activation * self._drive + self._torque * self._couple
        before = body.velocity
        try:
            body.step(dt, forces)
        except LeftTheGrid as error:
            fastest = float(np.abs(body.velocity[:, :2]).max())
            if fastest * dt < _FASTEST * self.settings.body.length:
                raise self._diverged(f"{error}; swimmer.steering keeps it there") from None
            raise self._diverged(
                "the motion grew without bounds; a shorter swimmer.numerics.step may help"
            ) from None
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
        """A torque that turns the fish back to the middle, without any net force [N m].

        It goes by heading h and place as averaged over `_STEER_TIME`, T, and by how that heading
        changes: from h it makes −(s + 2)/(T s + 1) h, with s = iω. For slow turns that is −2 h,
        within a beat nearly −h/T = −2.5 h. So it is a spring that holds the yaw, of stiffness
        5 gain I with the inertia I, and not a damper, but for some degrees of phase: it takes next
        to no power from the swimming, which `Work.steering` counts. It is not small: with gain 1 as
        much as 5/ω² of the inertia, 13 % at 1 Hz and 1.4 % at 3 Hz.
        """
        gain = self.settings.steering
        if not gain:
            return 0.0
        places, angle = self.beam.shape(self.beam.q)
        heading = float(self.beam.share @ angle)
        share = self.dt / _STEER_TIME
        changes = (heading - self._averaged_heading) / _STEER_TIME
        self._averaged_heading += share * (heading - self._averaged_heading)
        self._averaged_y += share * (float(self.beam.share @ places[:, 1]) - self._averaged_y)
        wanted = min(_STEER_MOST, max(-_STEER_MOST, _STEER_REACH * self._averaged_y))
        pull = _STEER_RATE * (wanted - self._averaged_heading) - changes
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
                self._torque * float(self._couple @ beam.rate),
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
            heading=heading,
            tail_angle=math.atan2(off, reach),
            tail_rate=float(off_rate * reach - reach_rate * off) / (reach**2 + off**2),
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
            "steered": np.array([self._averaged_heading, self._averaged_y]),
            "work": self._work.copy(),
            "hydrodynamic": self._hydrodynamic.copy(),
        }

    def restore(self, state: dict[str, Array]) -> None:
        """Go on from what `state` gave, to the last bit."""
        self.body.restore(state)
        self._steps = int(state["steps"])
        self._travelled = float(state["travelled"])
        self.activation = float(state["activation"])
        self._averaged_heading, self._averaged_y = map(float, state["steered"])
        self._work, self._hydrodynamic = state["work"].copy(), state["hydrodynamic"].copy()
