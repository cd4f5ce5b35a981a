"""Fish on its force sensor, advanced by whole windows of constant instruction angle.

It is used by the simulated hardware and by the theory of optimal controls. A window is integrated
to about 1e-9 in one step: the servo in closed form, the fin by collocation on a few segments.
"""

import math
from bisect import bisect_left
from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from msgspec import Struct

from fishd.virtual.plant.base import REST, Plant, PlantState
from fishd.virtual.plant.collocation import NODES, WEIGHTS, N, Segment, Vector
from fishd.virtual.plant.drive_train import (
    Cables,
    DelayLine,
    Part,
    log_sinh,
    relax,
    time_between,
)
from fishd.virtual.plant.held import WINDOW_COUNT, HeldWindow, HeldWindowMatrices, HeldWindows
from fishd.virtual.plant.motor import Motor, Stretch
from fishd.virtual.plant.parameters import MotorSettings, PlantParameters
from fishd.virtual.plant.servo_law import Approach

# Times around |sinh(lag/Δ)| = 1, in units of Δ/Ω. Before the first, the wheel runs at Ω, and after
# the last it stands, both to the last digit; in between, segments shorten towards the transition.
_TRANSITION = (-20, -10, -6, -4, -2.5, -1.5, -0.5, 0.5, 1.5, 3, 5, 8, 12, 20, 37)
_GRADED_FROM = 16.0
"""Length of a window from which graded segments are fewer than equal ones [Δ/Ω]."""
_MAX_FIN_SEGMENT = 3.0
"""Longest segment that N nodes resolve, in units of the fin's shortest time."""
_MAX_SINH_LAG = 300.0
"""Largest lag for sinh [Δ]; above it, the wheel runs at Ω during the whole segment."""
_ROUNDING = 1e-9
"""Tolerance that keeps a window of exactly one servo time constant as one segment."""
_DIGITS = 12
"""Digits of the times at which a segment is cut [s]: two closer ones are the same."""
_MIN_HELD_WINDOWS = 4
"""Duration of an instruction from which several windows are computed at once [windows]."""
_MAX_DRAG_SEGMENT_S = 0.05
"""Longest segment with quadratic drag [s]."""
REACTION_TIME = 0.01
"""Time constant of the mount that transmits the servo's reaction to the sensor [s]."""


class FinWindow(Struct, frozen=True, eq=False):
    """`Window` whose peak and power are computed when they are read.

    Attributes:
        course: segments of the window, with the motion of wheel and fin.
        motor: motor of the servo; None if its power is not needed.
        drives: speed/Ω of the wheel before and after the instruction, and the course, for each part
            of the window with pulses.
    """

    duration: float
    thrust: float
    lateral_force: float
    sampled_thrust: float
    sampled_lateral_force: float
    course: Sequence[Stretch]
    motor: Motor | None = None
    drives: Sequence[tuple[float, float, Sequence[Stretch]]] = ()

    @property
    def fin_peak(self) -> float:
        """Largest |α| within the window [rad]."""
        return max(stretch.segment.peak(stretch.response) for stretch in self.course)

    @property
    def power(self) -> float:
        """Mean electrical power of the servo [W]; NaN where the fish has no motor."""
        motor = self.motor
        if motor is None:
            return math.nan
        energy = 0.0
        for before, after, course in self.drives:
            energy += motor.jump(before, after)
            for stretch in course:
                energy += float(motor.energy(stretch))
        return motor.idle + energy / self.duration


AnyWindow: TypeAlias = FinWindow | HeldWindow


class TetheredFish(Plant[PlantParameters]):
    """Equations of Fu et al. with the effects of a real rig; not safe for use from several threads.

    Attributes:
        parameters: constants of this fish.
        state: current state; may be assigned.
        cables: cables between wheel and tail.
    """

    Settings = PlantParameters

    def __init__(
        self,
        parameters: PlantParameters,
        state: PlantState = REST,
        motor: MotorSettings | None = None,
    ) -> None:
        """motor: motor of the servo, if its power is needed"""
        super().__init__(parameters)
        self.state = state
        self.cables = Cables(parameters.cable_slack, parameters.backlash, state.phi)
        self._servo_time = parameters.servo_lag / parameters.servo_speed
        self._fin_segment = _MAX_FIN_SEGMENT / (parameters.omega0 * max(1.0, parameters.xi))
        self._segment = lru_cache(maxsize=512)(lambda *key: Segment(parameters, *key))
        self._equal_segments = lru_cache(maxsize=64)(self._segments)
        self._cause: Vector = np.zeros(N + 3)
        self._line = DelayLine(parameters.servo_delay) if parameters.servo_delay else None
        self._drag = parameters.quadratic_drag
        self._side_drag = parameters.lateral_quadratic_drag
        self._brakes = bool(self._drag or self._side_drag)
        self._momentum = 0.0
        """Momentum that the servo's reaction has transmitted to the sensor, −J φ̇ smoothed [N s]."""
        self._motor = Motor(motor, parameters) if motor else None
        self._speed = 0.0
        """Speed/Ω of the wheel at the end of the latest window; 0 where the servo had no pulses."""
        self._is_tanh = parameters.servo_law == "tanh"
        self._pulls = True
        """Whether the wheel moved the tail in the latest segment."""
        self._graded_from = _GRADED_FROM * self._servo_time
        self._is_plain = (
            self._is_tanh
            and self.cables.taut
            and not (self._line or self._brakes)
            and not (parameters.servo_dead_zone or parameters.servo_reaction)
        )
        self._request: tuple[float | None, float, int] = (None, 0.0, 0)
        self._request_windows, self._mean_request_windows = 0, 0.0
        """Number of windows of the current request, and a moving average over previous requests."""
        self._held: HeldWindows | None = None
        """Windows of this request that were computed at once."""
        self._expected: PlantState | None = None
        """State at the start of the next one of `_held`."""
        self._matrices_for = lru_cache(maxsize=8)(partial(HeldWindowMatrices, parameters))

    def advance(self, instruction_angle: float | None, duration: float, samples: int) -> AnyWindow:
        """Hold the instruction angle (rad) for `duration` s, and return the window.

        None means no pulses: the servo then holds the wheel at its angle. The sampled means are
        those of `samples` equally spaced instants, at which an ADC would be read; the reaction of
        the servo is the same in all of them. The servo acts on an instruction after its delay.

        Raises:
            ValueError: `duration` or `samples` is not positive.
        """
        if not (duration > 0.0 and samples > 0):
            raise ValueError(f"a window needs time and samples, not {duration} s and {samples}")
        if self._is_plain and instruction_angle is not None:
            request = (instruction_angle, duration, samples)
            held = self._held if self._is_known(request) else self._hold(*request)
            if held:
                return self._next_held_window(held, instruction_angle, duration)
        parts = [Part(instruction_angle, 0.0, duration)]
        if self._line:
            parts = self._line.advance(instruction_angle, duration)
        windows = []
        for part in parts:
            turn = part.begin + self._time_to_turn(part.instruction_angle)
            ends = (turn, part.end) if part.begin < turn < part.end else (part.end,)
            for begin, end in pairwise((part.begin, *ends)):
                windows.append(
                    self._advance_part(part.instruction_angle, duration, samples, (begin, end))
                )
        if len(windows) == 1:
            return windows[0]
        return FinWindow(
            duration,
            sum(w.thrust * w.duration for w in windows) / duration,
            sum(w.lateral_force * w.duration for w in windows) / duration,
            sum(w.sampled_thrust for w in windows),
            sum(w.sampled_lateral_force for w in windows),
            [stretch for w in windows for stretch in w.course],
            self._motor,
            [drive for w in windows for drive in w.drives],
        )

    def _is_known(self, request: tuple[float, float, int]) -> bool:
        """Return whether the next held window is that of a request from the present state."""
        held = self._held
        return (
            held is not None
            and held.taken < WINDOW_COUNT
            and self.state is self._expected
            and self._request == request
        )

    def _hold(self, instruction_angle: float, duration: float, samples: int) -> HeldWindows | None:
        """Return the next windows; None where the instruction may soon change.

        An instruction is expected to last as long as recent ones, or twice its current duration.
        """
        self._held = None
        request = (instruction_angle, duration, samples)
        if request == self._request:
            self._request_windows += 1
        else:
            request_windows = self._request_windows
            self._mean_request_windows = 0.5 * (
                self._mean_request_windows
                + (request_windows if request_windows < WINDOW_COUNT else WINDOW_COUNT)
            )
            self._request, self._request_windows = request, 1
        if (
            self._request_windows < _MIN_HELD_WINDOWS
            and self._mean_request_windows < _MIN_HELD_WINDOWS
        ):
            return None
        p, state = self.parameters, self.state
        lag = (instruction_angle - state.phi) / p.servo_lag
        segments = self._equal_segments(duration, samples, (0.0, duration))
        if len(segments) > 1 or duration > self._graded_from or abs(lag) > _MAX_SINH_LAG:
            return None
        self._held = held = self._matrices_for(segments[0], samples).swim(
            state, p.coupling * instruction_angle, lag
        )
        self._expected = state
        if self._motor:
            held.jump = self._motor.jump(self._speed, math.tanh(lag))
        return held

    def _next_held_window(
        self, held: HeldWindows, instruction_angle: float, duration: float
    ) -> HeldWindow:
        """Return the next window of a constant instruction."""
        p, k = self.parameters, held.taken
        held.taken += 1
        if k:  # the first one is counted already
            self._request_windows += 1
        alpha, rate, side_force, sampled_side_force = held.ends[k]
        thrust, sampled_thrust = held.thrusts[k]
        lag = math.sinh((instruction_angle - self.state.phi) / p.servo_lag)
        lag = math.asinh(held.stretch.segment.decay * lag)
        self._speed = math.tanh(lag)
        self.state = self._expected = PlantState(instruction_angle - p.servo_lag * lag, alpha, rate)
        return HeldWindow(
            duration, thrust, side_force, sampled_thrust, sampled_side_force, held, k, self._motor
        )

    def _advance_part(
        self,
        instruction_angle: float | None,
        window_length: float,
        samples: int,
        part: tuple[float, float],
    ) -> FinWindow:
        """Advance by a part of a window with one instruction at the servo.

        part: begin and end of the part in the window (s); sampled means are the contribution of the
            part to those of the window
        """
        p = self.parameters
        duration = part[1] - part[0]
        phi, alpha, rate = start = self.state
        target = phi if instruction_angle is None else instruction_angle
        if p.servo_dead_zone:
            target = self._apply_dead_zone(target, phi)
        lag = (target - phi) / p.servo_lag
        cuts: Sequence[float] = ()
        before = self._speed
        if self._is_tanh:
            after = math.tanh(lag)
            if lag and (duration > self._graded_from or not self.cables.taut):
                cuts = self._cuts(target, phi, lag, duration)
        else:
            if instruction_angle is None:
                self._speed = 0.0
            approach = Approach(p.servo_law, lag, self._speed)
            after = approach.first_speed
            cuts = self._cuts_of(approach, target, phi, duration)
        segments: Sequence[Segment] = (
            self._segments(window_length, samples, part, cuts)
            if cuts
            else self._equal_segments(window_length, samples, part)
        )

        responses: Sequence[Vector] = ()
        if self._brakes:
            segments, responses = self._cut_at_turns(segments, target, lag)
        cause = self._cause
        course: list[Stretch] = []
        thrust = sampled_thrust = sampled_acceleration = sampled_rate = 0.0
        braking = sampled_braking = 0.0
        momentum = self._momentum
        for segment in segments:
            cause[0], cause[1] = alpha, rate
            lags, lag, motion = self._drive(segment, target, lag)
            # dot() has half the overhead of @.
            response = responses[len(course)] if responses else segment.response.dot(cause)
            course.append(Stretch(segment, response, lags, self._pulls, motion))
            integral, total = segment.sums.dot(response[:N] * response[2 * N : 3 * N]).tolist()
            alpha, rate, total_acceleration, total_rate = response[3 * N :].tolist()
            thrust -= integral
            sampled_thrust -= total
            sampled_acceleration += total_acceleration
            sampled_rate += total_rate
            if responses:
                rates = response[N : 2 * N]
                integral, total = segment.sums.dot(np.abs(rates) * rates).tolist()
                braking += integral
                sampled_braking += total

        pulsed = instruction_angle is not None
        drives = ((before, after, course),) if pulsed else ()
        if self._is_tanh or not pulsed:
            self._speed = math.tanh(lag) if pulsed else 0.0
        self.state = PlantState(target - p.servo_lag * lag, alpha, rate)
        inertia, drag = p.thrust_coefficient, p.lateral_drag
        side_inertia = p.lateral_inertia_ratio * inertia
        reaction = self._momentum - momentum
        braking, sampled_braking = self._side_drag * braking, self._side_drag * sampled_braking
        return FinWindow(
            duration,
            inertia * thrust / duration,
            -(
                side_inertia * (rate - start.alpha_rate)
                + drag * (alpha - start.alpha)
                + braking
                - reaction
            )
            / duration,
            inertia * sampled_thrust / samples,
            -(side_inertia * sampled_acceleration + drag * sampled_rate + sampled_braking) / samples
            + reaction / window_length,
            course,
            self._motor,
            drives,
        )

    def _cut_at_turns(
        self, segments: Sequence[Segment], target: float, lag: float
    ) -> tuple[Sequence[Segment], Sequence[Vector]]:
        """Cut segments at reversals of the fin, and return the parts with their responses.

        Quadratic drag has a kink there, which a polynomial cannot follow.
        """
        cause, before = self._cause, (self.cables.tail, self._momentum, self._speed)
        _, alpha, rate = self.state
        pieces: list[Segment] = []
        responses: list[Vector] = []
        to_do = list(reversed(segments))
        while to_do:
            segment = to_do.pop()
            cause[0], cause[1] = alpha, rate
            tail, speed = self.cables.tail, self._speed
            _, later, _ = self._drive(segment, target, lag)
            response = (
                segment.braked(cause, self._drag) if self._drag else segment.response.dot(cause)
            )
            if turn := segment.turn(response):
                self.cables.tail, self._speed = tail, speed
                later_instants = tuple(t - turn for t in segment.instants if t >= turn)
                to_do.append(self._segment(segment.length - turn, later_instants))
                to_do.append(self._segment(turn, tuple(t for t in segment.instants if t < turn)))
            else:
                pieces.append(segment)
                responses.append(response)
                lag = later
                alpha, rate = response[3 * N : 3 * N + 2].tolist()
        self.cables.tail, self._momentum, self._speed = before
        return pieces, responses

    def _apply_dead_zone(self, target: float, phi: float) -> float:
        """Return the angle that the wheel approaches [rad]: the edge of its dead zone."""
        dead = self.parameters.servo_dead_zone
        return phi if abs(target - phi) <= dead else target - math.copysign(dead, target - phi)

    def _time_to_turn(self, instruction_angle: float | None) -> float:
        """Return the time until an accelerating wheel turns that moves away from its angle [s]."""
        p = self.parameters
        if p.servo_law != "accelerating" or instruction_angle is None:
            return 0.0
        gap = self._apply_dead_zone(instruction_angle, self.state.phi) - self.state.phi
        return Approach(p.servo_law, gap / p.servo_lag, self._speed).turn * self._servo_time

    def _drive(
        self, segment: Segment, target: float, lag: float
    ) -> tuple[Vector, float, tuple[Vector, Vector] | None]:
        """Write the drive of the fin into the cause.

        Return lag/Δ at the nodes and at the end, and `Stretch.motion`.
        """
        p = self.parameters
        cause = self._cause
        motion = None
        length = segment.length / self._servo_time
        if not self._is_tanh:
            times = np.append(segment.node_times, (0.5 * length, length))
            lags, speeds, changes = Approach(p.servo_law, lag, self._speed).at(times)
            halfway, later = lags[N:].tolist()
            lags, motion = lags[:N], (speeds[:N], changes[:N])
            self._speed = float(speeds[-1])
        elif -_MAX_SINH_LAG < lag < _MAX_SINH_LAG:
            sinh = math.sinh(lag)
            lags = np.arcsinh(segment.node_decay * sinh)
            later = math.asinh(segment.decay * sinh)
        else:
            lags = lag - math.copysign(1.0, lag) * segment.node_times
            later = relax(lag, length)
        if p.servo_reaction:
            self._react(segment, motion[0] if motion else np.tanh(lags))
        cause[2] = p.coupling * target
        if self.cables.taut:
            cause[3:] = lags
        else:
            if self._is_tanh:
                halfway = relax(lag, 0.5 * length)
            self._pull(target, halfway, lags, later)
        return lags, later, motion

    def _pull(self, target: float, halfway: float, lags: Vector, later: float) -> None:
        """Apply backlash and slack to the drive of the fin during a segment.

        lags, halfway, later: lag/Δ of the wheel at the nodes, at the middle and at the end
        """
        p, cause = self.parameters, self._cause
        moves, angle = self.cables.pull(
            target - p.servo_lag * halfway, target - p.servo_lag * later
        )
        self._pulls = moves
        if moves:
            cause[2], cause[3:] = p.coupling * (target - angle), lags
        else:
            cause[2], cause[3:] = p.coupling * angle, 0.0

    def _react(self, segment: Segment, speeds: Vector) -> None:
        """Add the reaction to the wheel's acceleration in a segment; speeds: in Ω at its nodes."""
        p = self.parameters
        weights = np.exp((NODES - 1.0) * (segment.length / REACTION_TIME))
        pushed = float((WEIGHTS * weights).dot(speeds)) * segment.length / REACTION_TIME
        self._momentum *= math.exp(-segment.length / REACTION_TIME)
        self._momentum -= p.servo_reaction * p.servo_speed * pushed

    def _cuts(self, target: float, phi: float, lag: float, duration: float) -> list[float]:
        """Return the times (s) within the part at which segments must end."""
        p, unit = self.parameters, self._servo_time
        cuts = []
        if duration > self._graded_from:
            transition = log_sinh(lag)
            cuts = [unit * (transition + time) for time in _TRANSITION]
        if not self.cables.taut:
            for edge in self.cables.edges(phi, lag):
                if min(phi, target) < edge < max(phi, target):
                    cuts.append(unit * time_between(lag, (target - edge) / p.servo_lag))
        return sorted({cut for cut in cuts if 0.0 < cut < duration}) if cuts else cuts

    def _cuts_of(
        self, approach: Approach, target: float, phi: float, duration: float
    ) -> list[float]:
        """Return the times (s) at which segments must end, for another law than tanh."""
        p, unit = self.parameters, self._servo_time
        times = list(approach.kinks)
        if p.servo_law == "linear" and duration > self._graded_from:
            times += [times[0] + time for time in _TRANSITION if time > 0.0]
        if not self.cables.taut:
            end = target - p.servo_lag * float(approach.at(np.array([duration / unit]))[0][0])
            for edge in self.cables.edges(phi, end - phi):
                if min(phi, end) < edge < max(phi, end):
                    times.append(approach.time_to((target - edge) / p.servo_lag))
        cuts = {round(unit * time, _DIGITS) for time in times}
        return sorted(cut for cut in cuts if 0.0 < cut < round(duration, _DIGITS))

    def _segments(
        self,
        window_length: float,
        samples: int,
        part: tuple[float, float],
        cuts: Sequence[float] = (),
    ) -> tuple[Segment, ...]:
        """Return the segments of a part of a window, each with its sample instants."""
        duration = part[1] - part[0]
        longest = self._fin_segment
        if duration <= self._graded_from:
            longest = min(longest, self._servo_time)
        if self.parameters.servo_reaction:
            longest = min(longest, 5.0 * REACTION_TIME)
        if self._brakes:
            longest = min(longest, _MAX_DRAG_SEGMENT_S)
        instants = [(i + 0.5) * window_length / samples - part[0] for i in range(samples)]
        segments: list[Segment] = []
        first_index = bisect_left(instants, 0.0)
        for start, end in pairwise((0.0, *cuts, duration)):
            count = max(1, math.ceil((end - start) / longest - _ROUNDING))
            length = (end - start) / count
            for k in range(count):
                next_index = bisect_left(
                    instants, start + (k + 1) * length if k + 1 < count else end
                )
                inside = tuple(t - (start + k * length) for t in instants[first_index:next_index])
                segments.append(self._segment(length, inside))
                first_index = next_index
        return tuple(segments)
