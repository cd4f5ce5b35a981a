"""Free swimmer: a body with muscles in still water, advanced step by step."""

import math
from typing import NamedTuple

import numpy as np

from fishd.core.errors import FishdError
from fishd.virtual.swimmer.body import build_beam, curvature
from fishd.virtual.swimmer.flow import Flow
from fishd.virtual.swimmer.grid import Array, Grid, edges
from fishd.virtual.swimmer.immersed import Immersed, LeftTheGrid
from fishd.virtual.swimmer.settings import SwimmerSettings

FRONT_FRACTION = 0.4
"""Length of the front body, which hardly bends, as a fraction of the body; heading and angle of the
tail refer to it."""
REAR_FRACTION = 0.8
"""Begin of the rear body, as a fraction of the length. The angle of the tail is that of the middle
of the rear body, because the thin tip flutters."""
TAIL_FRACTION = 0.98
"""Place of the velocity of the tail, as a fraction of the length."""
FOLLOW_TIME = 0.05
"""Time constant with which the grid takes on the speed of the fish [s]."""
RECENTRE_RATE = 2.0
"""Rate at which the grid recentres on the middle of the fish [1/s]."""
MAX_COURANT_NUMBER = 1.0
"""Courant number above which the computation is invalid."""
_MAX_STEP_LENGTHS = 0.05
"""Motion in a step above which the computation has diverged [body lengths]."""
_CHECK_PERIOD_STEPS = 20
_STEER_TIME = 0.4
"""Time constant of the averages of heading and position for the steering [s]."""
_STEER_RATE = 2.0
"""Rate of the correction of the heading [1/s]; a gliding fish oscillates above 1/_STEER_TIME."""
_STEER_REACH = 10.0
"""Target heading per distance from the middle [rad/m]."""
_MAX_STEER_RAD = 0.3
"""Largest target heading [rad]."""


class Diverged(FishdError):
    """The computation has diverged; the message says when and why."""


class Motion(NamedTuple):
    """Motion of the fish at an instant; it swims towards −x, and y points to its right.

    Forces are those on a body one metre deep.
    """

    time: float
    """Time of the fish [s]."""
    x: float
    """x of the centre of mass in the laboratory [m]."""
    y: float
    """y of the centre of mass in the laboratory [m]."""
    speed: float
    """Speed forwards, along −x [m/s]."""
    heading: float
    """Angle of the front body to −x [rad]."""
    tail_angle: float
    """Angle of the rear body, seen from the middle of the front body [rad]."""
    tail_rate: float
    """Rate of `tail_angle` [rad/s]."""
    tail_y: float
    """y of the tip of the tail in the laboratory [m]."""
    tail_speed: float
    """Velocity of the tail at `TAIL_FRACTION` along y in the laboratory [m/s]."""
    thrust: float
    """Force of the water on the body along −x [N]."""
    side_force: float
    """Force of the water on the body along y [N]."""


class Work(NamedTuple):
    """Work since the start, of a body one metre deep [J]."""

    muscles: float
    """Work of the muscles on the body, and through it on the water, minus the work that they absorb
    while stretched."""
    water: float
    """Work of the body on the water."""
    forwards: float
    """Work of the slices that push the fish forwards: their force times its speed, at each
    instant."""
    sideways: float
    """Work of the body on the water across the swimming direction."""
    steering: float
    """Work of the torque that keeps the fish in the middle; negative where it brakes."""


class Fish:
    """Fish in its tank; `step` advances it by `settings.numerics.step`."""

    def __init__(self, settings: SwimmerSettings) -> None:
        """settings: as accepted by `feasibility.check`"""
        self.settings = settings
        body, water, numerics = settings.body, settings.water, settings.numerics
        self.dt = numerics.step
        self.beam = build_beam(settings)
        self.beam.q[0] = -0.5 * body.length
        length, width = numerics.fine_length * body.length, numerics.fine_width * body.length

        def centred_edges(size: float, fine: float, ratio: float) -> Array:
            return edges(-0.5 * size, 0.5 * size, (-0.5 * fine, 0.5 * fine), numerics.cell, ratio)

        grid = Grid(
            centred_edges(water.length, length, numerics.stretch_along),
            centred_edges(water.width, width, numerics.stretch_across),
        )
        self.flow = Flow(grid, water.viscosity, "slip")
        self.body = Immersed(self.flow, water.density, self.beam)
        self.activation = 0.0
        """Activation a, −1 to 1, during the latest step."""
        self._steps = 0
        self._travelled = np.zeros(2)
        self._drive = self.beam.drive(lambda X: curvature(settings, X))
        self._couple = self.beam.couple()
        # Moment of inertia of a rod with length and mass of the fish, and added one of a plate of
        # this length, π/8 ρ (L/2)⁴ (Newman, Marine Hydrodynamics, 1977, table 4.3) [kg m²/m].
        self._inertia = water.density * (
            self.beam.area * body.length**2 / 12.0 + math.pi / 8.0 * (0.5 * body.length) ** 4
        )
        self._averaged_heading = self._averaged_y = 0.0
        self._torque = 0.0
        self._work = np.zeros(5)
        self._hydrodynamic = np.zeros((self.beam.slices, 2))
        self._front = self.beam.share * (FRONT_FRACTION * body.length > self.beam.X)
        self._front /= self._front.sum()
        self._rear = self.beam.share * (REAR_FRACTION * body.length < self.beam.X)
        self._rear /= self._rear.sum()
        self._tail = int(np.abs(self.beam.X - TAIL_FRACTION * body.length).argmin())

    @property
    def time(self) -> float:
        """Time since the start [s]."""
        return self._steps * self.dt

    @property
    def work(self) -> Work:
        """Work since the start [J]."""
        return Work(*map(float, self._work))

    def step(self, activation: float) -> None:
        """Advance by one step with the activation a, clipped to −1 … 1.

        Raises `Diverged` where the result is not a swimming fish.
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
            if fastest * dt < _MAX_STEP_LENGTHS * self.settings.body.length:
                remedy = "more swimmer.steering, or a larger swimmer.numerics.fine_width, may help"
                raise self._diverged(f"{error}; {remedy}") from None
            raise self._diverged(
                "the motion grew without bounds; a shorter swimmer.numerics.step may help"
            ) from None
        except np.linalg.LinAlgError:
            raise self._diverged("the motion of the body has no solution") from None
        self._steps += 1
        self._account(before)
        speed = float(beam.share @ body.velocity[:, 0])
        places, _ = beam.shape(beam.q)
        grid_velocity = self.flow.grid_velocity
        self._travelled += dt * grid_velocity
        target = speed + RECENTRE_RATE * 0.5 * float(places[:, 0].min() + places[:, 0].max())
        grid_velocity[0] += dt / FOLLOW_TIME * (target - grid_velocity[0])
        # Across, it follows the mean over `_STEER_TIME`, and not the motion within a beat.
        y = float(beam.share @ places[:, 1])
        self._averaged_y += dt / _STEER_TIME * (y - self._averaged_y)
        grid_velocity[1] = RECENTRE_RATE * self._averaged_y
        if self._steps % _CHECK_PERIOD_STEPS == 0:
            courant = self.flow.courant_number(dt)
            if not courant < MAX_COURANT_NUMBER:
                raise self._diverged(
                    f"the water passes {courant:.2g} cells in a step; a shorter "
                    "swimmer.numerics.step may help"
                )

    def _diverged(self, reason: str) -> Diverged:
        return Diverged(f"the swimmer cannot go on at {self.time:.3f} s: {reason}")

    def _steer(self) -> float:
        """Return a torque without a net force that turns the fish back to the middle [N m].

        It uses heading h and position, averaged over `_STEER_TIME`, T, and the rate of change of
        that heading. Its transfer function from h is −(s + 2)/(T s + 1), s = iω. For slow turns
        this is −2, within a beat nearly −1/T = −2.5. It is therefore a spring against the yaw, of
        stiffness 5 gain I with the inertia I. Except for some degrees of phase it does not damp,
        and takes almost no power from the swimming, see `Work.steering`. It is not small: with gain
        1 it equals 5/ω² of the inertia, 13 % at 1 Hz and 1.4 % at 3 Hz.
        """
        gain = self.settings.steering
        if not gain:
            return 0.0
        _, angle = self.beam.shape(self.beam.q)
        heading = float(self.beam.share @ angle)
        share = self.dt / _STEER_TIME
        heading_rate = (heading - self._averaged_heading) / _STEER_TIME
        self._averaged_heading += share * (heading - self._averaged_heading)
        y = float(self._travelled[1]) + self._averaged_y
        target = min(_MAX_STEER_RAD, max(-_MAX_STEER_RAD, _STEER_REACH * y))
        pull = _STEER_RATE * (target - self._averaged_heading) - heading_rate
        return gain * _STEER_RATE * self._inertia * pull

    def _account(self, before: Array) -> None:
        """Add the work of the latest step; before: velocities of the slices before it."""
        body, beam, dt = self.body, self.beam, self.dt
        velocity = body.velocity
        change = (body.mass @ (velocity - before)[:, :, None])[:, :, 0] / dt
        water = change - body.force  # force of the surrounding water on each slice
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
        """Return the current motion."""
        beam, velocity = self.beam, self.body.velocity
        places, angle = beam.shape(beam.q)
        centre, mean = beam.share @ places, beam.share @ velocity
        front, front_rate = self._front @ places, self._front @ velocity
        heading = float(self._front @ angle)
        across = np.array([-math.sin(heading), math.cos(heading)])
        along = np.array([math.cos(heading), math.sin(heading)])
        arm = self._rear @ places - front
        lateral, forward = float(arm @ across), float(arm @ along)
        relative = (self._rear @ velocity - front_rate)[:2]
        lateral_rate = float(relative @ across) - front_rate[2] * forward
        forward_rate = float(relative @ along) + front_rate[2] * lateral
        return Motion(
            time=self.time,
            x=float(self._travelled[0] + centre[0]),
            y=float(self._travelled[1] + centre[1]),
            speed=-float(mean[0]),
            heading=heading,
            tail_angle=math.atan2(lateral, forward),
            tail_rate=float(lateral_rate * forward - forward_rate * lateral)
            / (forward**2 + lateral**2),
            tail_y=float(self._travelled[1] + self.midline()[-1, 1]),
            tail_speed=float(velocity[self._tail, 1]),
            thrust=-float(self._hydrodynamic[:, 0].sum()),
            side_force=float(self._hydrodynamic[:, 1].sum()),
        )

    def outline(self) -> Array:
        """Return the outline of the body on the grid, shape (2 slices, 2) [m]."""
        places, angle = self.beam.shape(self.beam.q)
        normal = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
        offset = self.beam.half_thickness[:, None] * normal
        return np.concatenate([places + offset, (places - offset)[::-1]])

    def midline(self) -> Array:
        """Return the positions of head, slices and tail on the grid, shape (slices + 2, 2) [m]."""
        places, angle = self.beam.shape(self.beam.q)
        half = 0.5 * self.beam.spacing * np.array([math.cos(angle[-1]), math.sin(angle[-1])])
        return np.concatenate([[self.beam.q[:2]], places, [places[-1] + half]])

    @property
    def travelled(self) -> Array:
        """Distance that the grid has moved in the laboratory, along x and y [m]."""
        return self._travelled

    def state(self) -> dict[str, Array]:
        """Return the complete state by name."""
        return self.body.state() | {
            "steps": np.array(self._steps),
            "travelled": self._travelled.copy(),
            "activation": np.array(self.activation),
            "steered": np.array([self._averaged_heading, self._averaged_y]),
            "work": self._work.copy(),
            "hydrodynamic": self._hydrodynamic.copy(),
        }

    def restore(self, state: dict[str, Array]) -> None:
        """Restore a result of `state` exactly."""
        self.body.restore(state)
        self._steps = int(state["steps"])
        self._travelled = state["travelled"].copy()
        self.activation = float(state["activation"])
        self._averaged_heading, self._averaged_y = map(float, state["steered"])
        self._work, self._hydrodynamic = state["work"].copy(), state["hydrodynamic"].copy()
