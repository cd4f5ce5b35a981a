"""Electrical power of the simulated servo: a DC motor with the values of its data sheet.

Its current is i = i₀ ω/Ω + τ/k_t, for the friction of the gears at the wheel's speed ω and for the
torque τ on tail and rotor. The supply provides (R i + k_e ω) i, of which R i² is copper loss
(Hughes and Drury, Electric Motors and Drives, 5th edition, chapter 3). From the data sheet,
R = U/i_stall, k_e = (U − R i₀)/Ω and k_t = τ_stall/i_stall. A braking motor does not return energy
to the supply.
"""

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from fishd.virtual.plant.collocation import WEIGHTS, N, Segment, Vector
from fishd.virtual.plant.parameters import MotorSettings, PlantParameters


class Stretch(Struct, frozen=True, eq=False):
    """Segment of a window, with the motion of wheel and fin."""

    segment: Segment
    response: Vector
    """Motion of the fin, the result of `Segment.response`."""
    lags: Vector
    """lag/Δ of the wheel at the nodes, shape (N,), or (n, N) for n segments of equal length."""
    pulls: bool
    """Whether the wheel moves the tail."""
    motion: tuple[Vector, Vector] | None = None
    """Speed/Ω of the wheel at the nodes, and its derivative by time in Δ/Ω; None for tanh."""


class Motor:
    """Motor of one servo, which computes the energy of a motion of its wheel.

    A change of the instruction makes the wheel's speed jump in the equations of the servo. The
    energy of a jump from ω₁ to ω₂ is that of a voltage step to k_e ω₂ until the rotor has followed,
    J ω₂ (ω₂ − ω₁) k_e/k_t, independent of the resistance.
    """

    def __init__(self, settings: MotorSettings, plant: PlantParameters) -> None:
        speed, lag = plant.servo_speed, plant.servo_lag
        resistance = settings.voltage / settings.stall_current
        back_emf = max(0.0, settings.voltage - resistance * settings.no_load_current) / speed
        torque_constant = settings.stall_torque / settings.stall_current
        self.idle = settings.voltage * settings.idle_current
        """Constant power of the electronics [W]."""
        self._speed = speed
        self._resistance = resistance
        braking = settings.rotor_inertia * speed**2 / lag / torque_constant  # A
        self._jump = settings.rotor_inertia * back_emf / torque_constant
        tail = plant.coupling * settings.tail_inertia / torque_constant
        self._emf = back_emf * speed / resistance  # at the highest speed, A
        self._braking = braking
        self._moving = settings.no_load_current - braking
        self._tail, self._drag = tail, tail * plant.xi * plant.omega0

    def jump(self, before: float, after: float) -> float:
        """Return the energy of a jump of the wheel's speed at an instruction [J].

        before, after: speed/Ω immediately before and after the instruction
        """
        return max(0.0, self._jump * self._speed**2 * after * (after - before))

    def energy(self, stretch: Stretch) -> NDArray[np.float64]:
        """Return the energy of a motion, or of each of several, without the idle current [J]."""
        response = stretch.response
        if stretch.motion:
            speeds, changes = stretch.motion[0].copy(), stretch.motion[1]
            current = (self._moving + self._braking) * speeds + self._braking * changes
        else:
            speeds = np.tanh(stretch.lags)  # relative to the highest speed
            current = speeds * speeds
            current *= self._braking
            current += self._moving
            current *= speeds
        if stretch.pulls:
            current += self._tail * response[..., 2 * N : 3 * N]
            current += self._drag * response[..., N : 2 * N]
        speeds *= self._emf
        speeds += current
        current *= speeds  # now the power over the resistance
        energy: NDArray[np.float64] = np.maximum(current, 0.0).dot(WEIGHTS)
        return energy * (self._resistance * stretch.segment.length)
