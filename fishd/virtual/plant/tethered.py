"""The fish on its force sensor, advanced by whole windows of constant instruction angle.

The simulated hardware and the theory of optimum controls both drive it. A window is integrated to
about 1e-9 in one step: the servo in closed form, the fin by collocation on a few segments.
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
from fishd.virtual.plant.drive_train import Cables, DelayLine, log_sinh, relax, time_between
from fishd.virtual.plant.held import COUNT, Ahead, HeldWindow, HeldWindows
from fishd.virtual.plant.motor import Motor, Stretch
from fishd.virtual.plant.parameters import MotorSettings, PlantParameters

# Times around |sinh(lag/Δ)| = 1, in units of Δ/Ω. Before the first the wheel runs at Ω and after
# the last it stands, both to the last digit; in between, segments shorten towards the transition.
_TRANSITION = (-20, -10, -6, -4, -2.5, -1.5, -0.5, 0.5, 1.5, 3, 5, 8, 12, 20, 37)
_GRADED_FROM = 16.0  # windows longer than this many Δ/Ω need fewer segments graded than equal
_FIN_REACH = 3.0  # segment length, in units of the fin's shortest time, that N nodes resolve
_LINEAR_LAG = 300.0  # in Δ; sinh is safe below, and above the wheel runs at Ω all segment long
_ROUNDING = 1e-9  # a window of exactly one servo time constant stays one segment
_HELD = 4  # an instruction that lasts so many windows makes it worth while to look ahead
_DRAG_STEP = 0.05  # longest segment with quadratic drag, s
REACTION_TIME = 0.01
"""Of the mount that passes the servo's reaction on to the sensor [s]."""


class FinWindow(Struct, frozen=True, eq=False):
    """A `Window` whose peak and power are worked out when they are read.

    Attributes:
        course: the segments of the window, with the motion of wheel and fin in each.
        motor: of the servo; None where its power is of no interest.
        drives: lag/Δ before and after the instruction, and the course, of each part of the window
            with pulses.
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
    """The equations of Fu et al., and what a real rig adds; not safe for use from several threads.

    Attributes:
        parameters: constants of this fish.
        state: where it is now; assign to it to put the fish elsewhere.
        cables: between wheel and tail.
    """

    Settings = PlantParameters

    def __init__(
        self,
        parameters: PlantParameters,
        state: PlantState = REST,
        motor: MotorSettings | None = None,
    ) -> None:
        """motor: of the servo, where its power is of interest"""
        super().__init__(parameters)
        self.state = state
        self.cables = Cables(parameters.cable_slack, parameters.backlash, state.phi)
        self._servo_time = parameters.servo_lag / parameters.servo_speed
        self._fin_segment = _FIN_REACH / (parameters.omega0 * max(1.0, parameters.xi))
        self._segment = lru_cache(maxsize=512)(lambda *key: Segment(parameters, *key))
        self._equal_segments = lru_cache(maxsize=64)(self._segments)
        self._cause: Vector = np.zeros(N + 3)
        self._line = DelayLine(parameters.servo_delay) if parameters.servo_delay else None
        self._drag = parameters.quadratic_drag
        self._side_drag = parameters.lateral_quadratic_drag
        self._brakes = bool(self._drag or self._side_drag)
        self._momentum = 0.0
        """What the servo's reaction has passed on to the sensor, −J φ̇ smoothed [N s]."""
        self._motor = Motor(motor, parameters) if motor else None
        self._lag = 0.0
        """lag/Δ at the end of the latest window; 0 where the servo had no pulses."""
        self._pulls = True
        """Did the wheel move the tail in the latest segment?"""
        self._graded_from = _GRADED_FROM * self._servo_time
        self._is_plain = self.cables.taut and not (
            self._line or self._brakes or parameters.servo_dead_zone or parameters.servo_reaction
        )
        self._request: tuple[float | None, float, int] = (None, 0.0, 0)
        self._lasted, self._usual = 0, 0.0
        """Number of windows of this request so far, and what it was of late on average."""
        self._held: HeldWindows | None = None
        """Windows of this request that were worked out at once."""
        self._expected: PlantState | None = None
        """The state at the start of the next one of these."""
        self._ahead = lru_cache(maxsize=8)(partial(Ahead, parameters))

    def advance(self, instruction_angle: float | None, duration: float, samples: int) -> AnyWindow:
        """Hold the instruction angle (rad) for `duration` s and return the forces meanwhile.

        None means no pulses: the servo then holds the wheel where it is. `samples` instants make
        the sampled means, as an ADC that is read evenly within the window does; the reaction of the
        servo is the same in all of them. The servo acts on an instruction after its delay.

        Raises:
            ValueError: `duration` or `samples` is not positive.
        """
        if not (duration > 0.0 and samples > 0):
            raise ValueError(f"a window needs time and samples, not {duration} s and {samples}")
        if self._is_plain and instruction_angle is not None:
            request = (instruction_angle, duration, samples)
            held = self._held if self._is_known(request) else self._hold(*request)
            if held:
                return self._take(held, instruction_angle, duration)
        if self._line is None:
            return self._swim(instruction_angle, duration, samples, (0.0, duration))
        parts = self._line.passed(instruction_angle, duration)
        if len(parts) == 1:
            return self._swim(parts[0].angle, duration, samples, (0.0, duration))
        windows = [
            self._swim(part.angle, duration, samples, (part.begin, part.end)) for part in parts
        ]
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

    def prepare(self, instruction_angle: float | None, duration: float, samples: int) -> None:
        """Compute the held windows of which the next one may be the first."""
        if self._is_plain and instruction_angle is not None:
            request = (instruction_angle, duration, samples)
            counted = self._request, self._lasted, self._usual
            if not self._is_known(request) and self._hold(*request) is None:
                self._request, self._lasted, self._usual = counted

    def _is_known(self, request: tuple[float, float, int]) -> bool:
        """Return whether the next held window is that of a request from the present state."""
        held = self._held
        return (
            held is not None
            and held.taken < COUNT
            and self.state is self._expected
            and self._request == request
        )

    def _hold(self, angle: float, duration: float, samples: int) -> HeldWindows | None:
        """Return windows to come; None where the instruction may soon change.

        It is expected to last as long as others of late, or as long again as it has lasted.
        """
        self._held = None
        request = (angle, duration, samples)
        if request == self._request:
            self._lasted += 1
        else:
            lasted = self._lasted
            self._usual = 0.5 * (self._usual + (lasted if lasted < COUNT else COUNT))
            self._request, self._lasted = request, 1
        if self._lasted < _HELD and self._usual < _HELD:
            return None
        p, state = self.parameters, self.state
        lag = (angle - state.phi) / p.servo_lag
        segments = self._equal_segments(duration, samples, (0.0, duration))
        if len(segments) > 1 or duration > self._graded_from or abs(lag) > _LINEAR_LAG:
            return None
        self._held = held = self._ahead(segments[0], samples).swim(state, p.coupling * angle, lag)
        self._expected = state
        if self._motor:
            held.jump = self._motor.jump(self._lag, lag)
        return held

    def _take(self, held: HeldWindows, angle: float, duration: float) -> HeldWindow:
        """Swim the next one of the windows of an instruction that is held."""
        p, k = self.parameters, held.taken
        held.taken += 1
        if k:  # the first one is counted
            self._lasted += 1
        alpha, rate, side_force, sampled_side_force = held.ends[k]
        thrust, sampled_thrust = held.thrusts[k]
        lag = math.sinh((angle - self.state.phi) / p.servo_lag)
        self._lag = lag = math.asinh(held.stretch.segment.decay * lag)
        self.state = self._expected = PlantState(angle - p.servo_lag * lag, alpha, rate)
        return HeldWindow(
            duration, thrust, side_force, sampled_thrust, sampled_side_force, held, k, self._motor
        )

    def _swim(
        self, angle: float | None, whole: float, samples: int, part: tuple[float, float]
    ) -> FinWindow:
        """Swim a part of a window in which the servo knows one instruction.

        part: when in the window it begins and ends (s); sampled means are those of the window, as
            far as the part adds to them
        """
        p = self.parameters
        duration = part[1] - part[0]
        phi, alpha, rate = start = self.state
        command = phi if angle is None else angle
        if p.servo_dead_zone:
            command = self._reached(command, phi)
        begin = lag = (command - phi) / p.servo_lag
        cuts: Sequence[float] = ()
        if lag and (duration > self._graded_from or not self.cables.taut):
            cuts = self._cuts(command, phi, lag, duration)
        segments: Sequence[Segment] = (
            self._segments(whole, samples, part, cuts)
            if cuts
            else self._equal_segments(whole, samples, part)
        )

        responses: Sequence[Vector] = ()
        if self._brakes:
            segments, responses = self._cut_at_turns(segments, command, lag)
        cause = self._cause
        course: list[Stretch] = []
        thrust = sampled_thrust = sampled_acceleration = sampled_rate = 0.0
        braking = sampled_braking = 0.0
        momentum = self._momentum
        for segment in segments:
            cause[0], cause[1] = alpha, rate
            lags, lag = self._drive(segment, command, lag)
            # Half the overhead of @:
            response = responses[len(course)] if responses else segment.response.dot(cause)
            course.append(Stretch(segment, response, lags, self._pulls))
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

        pulsed = angle is not None
        drives = ((self._lag, begin, course),) if pulsed else ()
        self._lag = lag if pulsed else 0.0
        self.state = PlantState(command - p.servo_lag * lag, alpha, rate)
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
            + reaction / whole,
            course,
            self._motor,
            drives,
        )

    def _cut_at_turns(
        self, segments: Sequence[Segment], command: float, lag: float
    ) -> tuple[Sequence[Segment], Sequence[Vector]]:
        """Cut where the fin turns, and return the parts with what the fin does in each.

        Quadratic drag has a kink there that no polynomial follows.
        """
        cause, before = self._cause, (self.cables.tail, self._momentum)
        _, alpha, rate = self.state
        pieces: list[Segment] = []
        responses: list[Vector] = []
        to_do = list(reversed(segments))
        while to_do:
            segment = to_do.pop()
            cause[0], cause[1] = alpha, rate
            tail = self.cables.tail
            _, later = self._drive(segment, command, lag)
            response = (
                segment.braked(cause, self._drag) if self._drag else segment.response.dot(cause)
            )
            if turn := segment.turn(response):
                self.cables.tail = tail
                rest = tuple(t - turn for t in segment.instants if t >= turn)
                to_do.append(self._segment(segment.length - turn, rest))
                to_do.append(self._segment(turn, tuple(t for t in segment.instants if t < turn)))
            else:
                pieces.append(segment)
                responses.append(response)
                lag = later
                alpha, rate = response[3 * N : 3 * N + 2].tolist()
        self.cables.tail, self._momentum = before
        return pieces, responses

    def _reached(self, angle: float, phi: float) -> float:
        """Return where the wheel goes [rad]: the edge of its dead zone."""
        dead = self.parameters.servo_dead_zone
        return phi if abs(angle - phi) <= dead else angle - math.copysign(dead, angle - phi)

    def _drive(self, segment: Segment, command: float, lag: float) -> tuple[Vector, float]:
        """Put what drives the fin into the cause; return lag/Δ at the nodes and at the end."""
        p = self.parameters
        cause = self._cause
        if -_LINEAR_LAG < lag < _LINEAR_LAG:
            sinh = math.sinh(lag)
            lags = np.arcsinh(segment.node_decay * sinh)
            later = math.asinh(segment.decay * sinh)
        else:
            lags = lag - math.copysign(1.0, lag) * segment.node_times
            later = relax(lag, segment.length / self._servo_time)
        if p.servo_reaction:
            self._react(segment, lags)
        cause[2] = p.coupling * command
        if self.cables.taut:
            cause[3:] = lags
        else:
            self._pull(segment, command, lag, lags, later)
        return lags, later

    def _pull(
        self, segment: Segment, command: float, lag: float, lags: Vector, later: float
    ) -> None:
        """Take backlash and slack off what the wheel does to the fin during the segment."""
        p, cause = self.parameters, self._cause
        halfway = relax(lag, 0.5 * segment.length / self._servo_time)
        moves, angle = self.cables.pull(
            command - p.servo_lag * halfway, command - p.servo_lag * later
        )
        self._pulls = moves
        if moves:
            cause[2], cause[3:] = p.coupling * (command - angle), lags
        else:
            cause[2], cause[3:] = p.coupling * angle, 0.0

    def _react(self, segment: Segment, lags: Vector) -> None:
        """Add what the wheel's acceleration passes on during the segment; lags: at its nodes."""
        p = self.parameters
        left = np.exp((NODES - 1.0) * (segment.length / REACTION_TIME))
        pushed = float((WEIGHTS * left).dot(np.tanh(lags))) * segment.length / REACTION_TIME
        self._momentum *= math.exp(-segment.length / REACTION_TIME)
        self._momentum -= p.servo_reaction * p.servo_speed * pushed

    def _cuts(self, command: float, phi: float, lag: float, duration: float) -> list[float]:
        """Return the times (s) within the part at which no segment may go on."""
        p, unit = self.parameters, self._servo_time
        cuts = []
        if duration > self._graded_from:
            transition = log_sinh(lag)
            cuts = [unit * (transition + time) for time in _TRANSITION]
        if not self.cables.taut:
            for edge in self.cables.edges(phi, lag):
                if min(phi, command) < edge < max(phi, command):
                    cuts.append(unit * time_between(lag, (command - edge) / p.servo_lag))
        return sorted({cut for cut in cuts if 0.0 < cut < duration}) if cuts else cuts

    def _segments(
        self, whole: float, samples: int, part: tuple[float, float], cuts: Sequence[float] = ()
    ) -> tuple[Segment, ...]:
        """Return the segments of a part of a window, each with the sample instants in it."""
        duration = part[1] - part[0]
        longest = self._fin_segment
        if duration <= self._graded_from:
            longest = min(longest, self._servo_time)
        if self.parameters.servo_reaction:
            longest = min(longest, 5.0 * REACTION_TIME)
        if self._brakes:
            longest = min(longest, _DRAG_STEP)
        instants = [(i + 0.5) * whole / samples - part[0] for i in range(samples)]
        segments: list[Segment] = []
        taken = bisect_left(instants, 0.0)
        for start, end in pairwise((0.0, *cuts, duration)):
            count = max(1, math.ceil((end - start) / longest - _ROUNDING))
            length = (end - start) / count
            for k in range(count):
                upto = bisect_left(instants, start + (k + 1) * length if k + 1 < count else end)
                inside = tuple(t - (start + k * length) for t in instants[taken:upto])
                segments.append(self._segment(length, inside))
                taken = upto
        return tuple(segments)
