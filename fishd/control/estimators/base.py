"""The base class of estimators, and the beat of the tail that all of them report."""

import math
from abc import ABC, abstractmethod

from msgspec.structs import replace

from fishd.core.signals import MAX_SIDE_TIME_S, Measurement, Observation


class TailBeat:
    """Tail-beat frequency and thrust, from sums over half beats: from one reversal to the next.

    A mean over whole beats is free of the ripple of the thrust within a beat.
    """

    _REST_TIME_S = 1.0
    """Time constant of the mean force while the tail does not beat [s]."""

    def __init__(self, span: float = 4.0) -> None:
        """span: time that the means cover at most [s]; they cover at least one beat"""
        self._span = span
        self.thrust = 0.0
        """Mean force over the beats of `frequency`; over about a second when not beating [N]."""
        self.rest()

    def rest(self) -> None:
        """Forget all beats, but not the mean force."""
        self._halves: list[tuple[float, float]] = []  # (duration [s], impulse [N s])
        self._side = 0.0
        self.side_time = 0.0
        """Time since the angle came to its side of neutral, up to 2 s, with its sign [s]."""
        self._open: tuple[float, float] | None = None
        self._longest = 0.0
        self.frequency = 0.0
        """Frequency of the latest whole beats; 0 when not beating [Hz]."""

    def update(self, instruction_angle: float, force: float, duration: float) -> None:
        """Add a window.

        instruction_angle: instruction angle applied during the window [rad]
        force: mean longitudinal force of the window [N]
        duration: its length [s]
        """
        side = self._side
        if instruction_angle:
            side = 1.0 if instruction_angle > 0.0 else -1.0
            elapsed = duration
            if side * self.side_time > 0.0:
                elapsed += side * self.side_time
            self.side_time = side * (elapsed if elapsed < MAX_SIDE_TIME_S else MAX_SIDE_TIME_S)
        else:
            self.side_time = 0.0
        if side != self._side:
            if self._side:
                self._reverse()
            self._side = side
        if self._open is not None:
            elapsed, impulse = self._open
            self._open = (elapsed + duration, impulse + force * duration)
            # Twice as long as the longest half beat: the tail has stopped.
            if self.frequency and elapsed > 2.0 * self._longest:
                self._halves.clear()
                self._open = None
                self.frequency = 0.0
        if not self.frequency:
            self.thrust -= math.expm1(-duration / self._REST_TIME_S) * (force - self.thrust)

    def _reverse(self) -> None:
        """Close the open half beat, unless it began before the first reversal and is incomplete."""
        halves = self._halves
        if self._open is not None:
            halves.append(self._open)
        self._open = (0.0, 0.0)
        while len(halves) > 3 and _sums(halves)[0] > self._span:
            del halves[0]
        if len(halves) < 2:
            return
        whole = halves[len(halves) % 2 :]
        self._longest = max(whole)[0]
        time, impulse = _sums(whole)
        self.frequency = 0.5 * len(whole) / time
        self.thrust = impulse / time


def _sums(halves: list[tuple[float, float]]) -> tuple[float, float]:
    """Return the sums of some half beats: durations [s] and impulses [N s]."""
    duration = impulse = 0.0
    for half_duration, half_impulse in halves:
        duration += half_duration
        impulse += half_impulse
    return duration, impulse


class Estimator(ABC):
    """An estimator: adds force rate, fin velocity, thrust and beat frequency to measurements."""

    def __init__(self) -> None:
        self.fy_corrected = False
        """Whether the sign of the measured F_y is reversed before use."""
        self.found_leak: float | None = None
        """Leak time in use [s], if the estimator finds it; else None."""
        self._fy: float | None = None
        self._instruction_angle: float | None = None
        self._beat = TailBeat()

    def rest(self) -> None:
        """Note that no controller moves the tail any more, so it does not beat."""
        self._beat.rest()

    def forget_zero(self) -> None:
        """Discard earlier forces, since the zero of the sensor was set."""
        self._fy = None

    def reverse_fy(self) -> None:
        """Reverse the sign of F_y from now on, also in the stored state."""
        self.fy_corrected = not self.fy_corrected
        if self._fy is not None:
            self._fy = -self._fy

    def update(
        self,
        measurement: Measurement,
        instruction_angle: float,
        time: float,
        dt: float,
        thrust_factor: tuple[float, float] | None = None,
    ) -> Observation:
        """Return the observation of the tick at `time`.

        instruction_angle: angle applied since the previous tick [rad]
        time: start of the tick [s, monotonic]
        dt: time since the previous tick [s]
        thrust_factor: latest factor of the thrust, and the half-width of its interval [N]
        """
        factor, ci95 = thrust_factor or (None, None)
        if self.fy_corrected:
            measurement = replace(measurement, fy=-measurement.fy)
        fy = measurement.fy
        fy_rate = (fy - self._fy) / dt if self._fy is not None else 0.0
        if measurement.samples:
            self._fy = fy
        before = instruction_angle if self._instruction_angle is None else self._instruction_angle
        self._instruction_angle = instruction_angle
        self._beat.update(instruction_angle, measurement.fx, dt)
        return Observation(
            time=time,
            dt=dt,
            fx=measurement.fx,
            fy=fy,
            fy_rate=fy_rate,
            fin_velocity=self.fin_velocity(measurement, instruction_angle, dt),
            instruction_angle=instruction_angle,
            previous_angle=before,
            thrust=self._beat.thrust,
            frequency=self._beat.frequency,
            thrust_factor=factor,
            thrust_factor_ci95=ci95,
            side_time=self._beat.side_time,
        )

    @abstractmethod
    def fin_velocity(self, measurement: Measurement, instruction_angle: float, dt: float) -> float:
        """Return the fin velocity at the end of a measurement; called once a tick.

        measurement: with the corrected sign of F_y
        """
