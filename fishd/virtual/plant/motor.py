"""What the simulated servo draws from its supply: a DC motor, known by its data sheet.

Its current is i = i₀ ω/Ω + τ/k_t, for the friction of its gears at the wheel's speed ω and for the
torque τ that turns tail and rotor; the supply gives (R i + k_e ω) i, copper loss and the rest
(Hughes and Drury, Electric Motors and Drives, 5th edition, chapter 3). From the data sheet,
R = U/i_stall, k_e = (U − R i₀)/Ω and k_t = τ_stall/i_stall. The supply gets nothing back from a
motor that brakes.
"""

import math

import numpy as np

from fishd.virtual.plant.collocation import WEIGHTS, N, Segment, Vector
from fishd.virtual.plant.parameters import MotorSettings, PlantParameters

_NOTHING: Vector = np.zeros(N)


class Motor:
    """Follows a wheel, and adds up what that takes [J]; the idle current is not in it.

    A change of the instruction makes the wheel's speed jump in the equations of the servo. The
    energy of a jump from ω₁ to ω₂ is what a voltage that steps to k_e ω₂ gives until the rotor has
    followed: J ω₂ (ω₂ − ω₁) k_e/k_t, whatever the resistance.
    """

    def __init__(self, settings: MotorSettings, plant: PlantParameters) -> None:
        """A motor at rest."""
        speed, lag = plant.servo_speed, plant.servo_lag
        resistance = settings.voltage / settings.stall_current
        back_emf = max(0.0, settings.voltage - resistance * settings.no_load_current) / speed
        torque_constant = settings.stall_torque / settings.stall_current
        self.idle = settings.voltage * settings.idle_current
        """What is drawn all the time [W]."""
        self._speed = speed
        self._resistance = resistance
        braking = settings.rotor_inertia * speed**2 / lag / torque_constant  # A
        self._jump = settings.rotor_inertia * back_emf / torque_constant
        tail = plant.coupling * settings.tail_inertia / torque_constant
        # As vectors: NumPy takes twice as long to multiply by a float.
        self._emf = np.full(N, back_emf * speed / resistance)  # at the highest speed, A
        self._braking = np.full(N, braking)
        self._moving = np.full(N, settings.no_load_current - braking)
        self._tail, self._drag = np.full(N, tail), np.full(N, tail * plant.xi * plant.omega0)
        self._rate = 0.0  # of the wheel at the end of what was followed, rad/s
        self._speeds: Vector = np.zeros(N)  # over the highest, at the nodes
        self._current: Vector = np.zeros(N)  # A

    def begin(self, lag: float) -> float:
        """Turn on with another lag/Δ; what the jump of the speed takes [J]."""
        rate = self._speed * math.tanh(lag)
        return max(0.0, self._jump * rate * (rate - self._rate))

    def turn(self, lags: Vector) -> None:
        """Follow the wheel through a segment, without the tail. lags: lag/Δ at its nodes, (N,)"""
        speeds, current = self._speeds, self._current
        np.tanh(lags, out=speeds)
        np.multiply(speeds, speeds, out=current)
        current *= self._braking
        current += self._moving
        current *= speeds

    def spent(self, segment: Segment, response: Vector | None) -> float:
        """What the segment took that was turned through last [J].

        response: of the fin, as `Segment.response` gives it; None where the wheel does not pull it
        """
        current, power = self._current, self._speeds
        if response is not None:
            current += self._tail * response[2 * N : 3 * N]
            current += self._drag * response[N : 2 * N]
        power *= self._emf
        power += current
        power *= current
        np.maximum(power, _NOTHING, out=power)
        return self._resistance * segment.length * float(WEIGHTS.dot(power))

    def end(self, lag: float) -> None:
        """Remember the speed that a lag/Δ stands for; 0 where the servo has no pulses."""
        self._rate = self._speed * math.tanh(lag)
