"""Fin angle from each picture of a tail that was learned.

The angle is the direction of the straight line through the fin's middles. It is given only if the
rest of the picture agrees: the midline has the learned shape for that angle, nothing else covers
the ground, and the fin did not jump.
"""

import math
from collections import deque
from typing import NamedTuple

import cv2
import numpy as np

from fishd.camera.tail.ground import Floats, Ground, Mask, shrink
from fishd.camera.tail.learned import CannotUse, Learned, find_stations
from fishd.camera.tail.learner import cut_off_side
from fishd.camera.tail.profile import (
    SATURATED,
    Array,
    Line,
    Pose,
    Trace,
    Tracer,
    fit_line,
)
from fishd.camera.tail.scene import Scene
from fishd.camera.tail.shape import Fit, Shape
from fishd.core.camera_frames import Pixels
from fishd.core.tail_reading import MIDLINE_POINTS, TailReading

_MIN_LENGTH = 0.55
"""Shortest part of the tail that must be seen."""
_MAX_FOREIGN = 0.006
"""Largest fraction of the picture that something else may cover."""
_FOREIGN_LEVEL = 0.5
"""Change of a pixel that something else causes, relative to that by the tail."""
_MIN_FIN_SEEN = 0.6
"""Smallest fraction of the fin's stations that must be seen."""
_MAX_SHAPE_ERROR = 0.004
"""Permitted distance of a midline from the learned shape, relative to the picture's width. The
permitted mean of the latest ones is half of it."""
_USUAL_ERROR, _USUAL_RECENT_ERROR = 1.5, 1.0
"""Permitted distance, and permitted mean of the latest ones, relative to the distance that 95 % of
the learned pictures stay below; they count if they are larger."""
_MIN_DIFFERENCE_RAD, _MAX_DIFFERENCE_RAD = 0.03, 0.045
"""Range of the permitted difference of the fin's direction from that by the learned shape [rad]."""
_USUAL_DIFFERENCE = 3.0
"""Permitted difference, relative to the one that 95 % of the learned pictures stay below."""
_MAX_TURN_RAD = 0.03
"""Permitted turn of a midline about its root in one picture [rad]."""
_WAVE_GAIN, _SHAPE_GAIN = 1.8, 2.0
"""Error of the fin's line by waves, in distances from it relative to its length, and half-width of
the interval of the shape's angle, in `Fit.alpha_error`."""
_MIN_WAVE_RAD = 0.006
"""Difference of the line from the shape below which waves do not matter [rad]."""
_SEEN_TURN = 2.5
"""Factor of the permitted turns of a midline beside edges that show a turn of the camera."""
_USUAL_TURN, _USUAL_RECENT_TURN = 1.6, 1.0
"""Permitted turn of a midline, and permitted mean of the latest ones, relative to the turn that
95 % of the learned pictures stay below; they count if they are larger."""
_KNOCK_S, _DOUBT_S = 0.8, 0.1
"""Times over which the turn of the midlines is averaged, for the zero and for one picture [s]."""
_KNOCK_RAD = 0.012
"""Mean turn above which the zero has moved [rad]."""
_MEAN_TURN = 0.5
"""Mean turn above which the zero has moved, relative to the turn that 95 % of the learned pictures
stay below."""
_MOVED_S = 0.3
"""Time for which the angle stays unknown after pictures that show a move of the camera, as waves
hide it from others [s]."""
_MIN_KNOCK_READINGS, _MIN_DOUBT_READINGS = 5, 2
_MIN_SIDE_READINGS = 6
"""Number of readings from which a side of the swing counts for itself."""
_SCENE_S = 0.2
"""Time between searches for the pose of a camera that has moved [s]."""
_SCENE_STEPS = 10
"""Number of steps of such a search."""
_MAX_SHIFT, _MAX_SCENE_TURN_RAD = 0.004, 0.02
"""Permitted shift, relative to the picture's width, and turn of the scene [rad]."""
_SCENE_USUAL = 2.0
"""The same, relative to that of 95 % of the learned pictures, if that is larger."""
_MAX_DISAGREEMENT = 0.8
"""Largest difference of the scene's edges that such a pose leaves, relative to that without."""
_MAX_UNEXPLAINED = 0.25
"""Largest part of what covers the ground that a move of the camera leaves unexplained."""
_JUMP_RAD = 0.06
"""Permitted change between two pictures, in addition to that at the highest speed [rad]."""
_JUMP_RATE = 1.5
"""Permitted speed, relative to the highest one during learning."""
_JUMP_S = 0.2
"""Longest time between two pictures whose change is judged [s]."""
_SPAN = 1.25
"""Range of angles relative to that learned."""
_OTHER_SHAPE = "the tail does not have the learned shape"
_MIN_REPEATED_RATE, _STOP_S = 0.3, 0.15
"""Recent speed of the fin above which two equal pictures are one that the camera repeats [rad/s],
and the time constant with which it is forgotten, as a fin cannot stop at once [s]."""


class _Seen(NamedTuple):
    """Fin and midline in one picture."""

    trace: Trace
    line: Line
    fit: Fit
    alpha: float


class TailMeter:
    """Meter of the fin angle."""

    def __init__(self, learned: Learned) -> None:
        self.learned = learned
        self._ground = Ground(
            learned.background_picture(), learned.size, learned.tail_level, learned.swept_mask()
        )
        self._half = np.array(learned.half_thickness)
        self._pose = Pose(learned.root, learned.direction)
        self._tracer = Tracer(
            self._ground, self._pose, float(self._half.max()), learned.length, self._half,
            learned.lens,
        )  # fmt: skip
        self._shape = Shape(np.array(learned.shape), np.array(learned.covariance))
        self._scene = Scene(self._ground)
        self._fin = find_stations(learned.fin)
        self._fin_length = learned.length * (learned.fin[1] - learned.fin[0])
        low, high = learned.span
        self._span = _SPAN * low - 0.05, _SPAN * high + 0.05
        empty = float(np.median(learned.background_picture()[learned.swept_mask()]))
        self._hides_lamps = learned.tail_level > empty or empty >= SATURATED
        width = learned.size[0]
        self._max_error = max(_MAX_SHAPE_ERROR * width, _USUAL_ERROR * learned.shape_error)
        self._max_recent_error = max(
            0.5 * _MAX_SHAPE_ERROR * width, _USUAL_RECENT_ERROR * learned.shape_error
        )
        self._max_difference = min(
            max(_MIN_DIFFERENCE_RAD, _USUAL_DIFFERENCE * learned.direction_error),
            _MAX_DIFFERENCE_RAD,
        )
        self._turns: deque[tuple[float, float, bool]] = deque()
        """Time, turn, and whether the fin is on the positive side."""
        self._errors: deque[tuple[float, float]] = deque()
        """Time and distance from the learned shape [px]."""
        usual = _SCENE_USUAL * np.array(learned.pose_error)
        shift = _MAX_SHIFT * width
        self._max_pose = np.maximum([shift, shift, _MAX_SCENE_TURN_RAD], usual)
        """Permitted shift along the rows and down [px], and turn [rad]."""
        # Half a pixel looks like a turn; the edges of a body show better whether there was one.
        factor = 1.0 if self._scene.is_blind else _SEEN_TURN
        self._max_turn = max(factor * _MAX_TURN_RAD, _USUAL_TURN * learned.turn_error)
        self._max_recent_turn = max(
            factor * _KNOCK_RAD * math.sqrt(_KNOCK_S / _DOUBT_S),
            _USUAL_RECENT_TURN * learned.turn_error,
        )
        self._max_mean_turn = max(factor * _KNOCK_RAD, _MEAN_TURN * learned.turn_error)
        self._poses: list[Array] = []
        """Poses of a camera that has moved."""
        self._scene_searched = -math.inf
        self._zero_moved = ""
        self._moved = -math.inf, ""
        """Time of the latest picture that shows a move of the camera, and its reason."""
        self._moved_until = -math.inf
        self._small: Pixels | None = None
        """Previous picture, shrunk."""
        self._last: tuple[float, float] | None = None
        self._rate = 0.0
        """Speed of the fin before `_last` [rad/s]."""
        self._motion = 0.0
        """Largest recent speed of the fin [rad/s]."""
        self._spread = (learned.direction_error / 2.0) ** 2
        """Recent mean square of the difference from the learned shape [rad²]."""
        self._waves = 0.0
        """Recent mean square of the distances from the fin's line, in lengths of the fin."""

    def read(
        self, time: float, picture: Pixels, row_time: float = 0.0, column_time: float = 0.0
    ) -> TailReading:
        """Return what a whole turned picture shows.

        time: middle of the exposure of the middle of the picture [s]
        row_time: time from the exposure of the first row to that of the last one [s]
        column_time: the same for the columns, of a picture that was turned by 90° [s]
        """
        zero = self.learned.zero
        try:
            self.learned.check_size(picture.shape[1], picture.shape[0])
        except CannotUse as error:
            return TailReading(time=time, zero=zero, reason=str(error))
        small = shrink(picture)
        if self._small is None or not np.array_equal(small, self._small):
            self._small = small
        elif self._motion > _MIN_REPEATED_RATE:
            return TailReading(time=time, zero=zero, reason="the camera repeats a picture")
        light = self._ground.light(small)
        cover = self._ground.cover(small, light)
        trace = self._tracer.trace_cover(picture, light, cover)
        if trace is None:
            return TailReading(time=time, zero=zero, reason="no tail where it was learned")
        places = trace.places
        middle = places[self._fin].mean(axis=0)
        height, width = picture.shape
        time += row_time * (float(middle[1]) / max(height - 1, 1) - 0.5)
        time += column_time * (float(middle[0]) / max(width - 1, 1) - 0.5)
        tip = places[-1] + 0.5 * (places[-1] - places[-2])
        line = np.concatenate([[self._pose.root], places, [tip]])
        chosen = line[np.linspace(0, len(line) - 1, MIDLINE_POINTS).round().astype(int)]
        lag = row_time * places[:, 1] / max(height - 1, 1) + column_time * places[:, 0] / max(
            width - 1, 1
        )
        seen = self._look(trace, lag - lag[self._fin].mean(), time)
        reason = self._find_fault(seen, small, light, cover, places, time)
        alpha, uncertainty = None, None
        # Also of a tail that seems turned, as the next picture is corrected for the fin's speed.
        if seen is not None and (not reason or (reason == _OTHER_SHAPE and self._is_whole(seen))):
            alpha, uncertainty = self._weigh(seen)
            if self._last is not None and time > self._last[0]:
                span = time - self._last[0]
                self._rate = (alpha - self._last[1]) / span
                self._motion = max(abs(self._rate), self._motion * math.exp(-span / _STOP_S))
            self._last = time, alpha
            if reason:
                alpha, uncertainty = None, None
        return TailReading(
            time=time,
            alpha=alpha,
            zero=zero,
            uncertainty=uncertainty,
            reason=reason,
            tip=(float(tip[0]), float(tip[1])),
            midline=tuple((float(x), float(y)) for x, y in chosen),
        )

    def _look(self, trace: Trace, lag: Array, time: float) -> _Seen | None:
        """Return line and shape; None where too little of the fin is seen.

        lag: time from the exposure of the fin to that of each station [s]
        """
        weight = trace.weight if self._hides_lamps else trace.weight * ~trace.glaring
        fin = weight[self._fin]
        if fin.sum() < _MIN_FIN_SEEN * len(fin):
            return None
        points = trace.points
        line = fit_line(points[self._fin], fin)
        zero = self.learned.zero
        if lag.any() and self._last is not None and 0.0 < time - self._last[0] < _JUMP_S:
            # Rows of a rolling shutter show the tail at different times.
            rate = (line.angle - zero - self._last[1]) / (time - self._last[0])
            rate += 0.5 * (rate - self._rate)  # it is that of half a picture ago
            points = points - (rate * lag)[:, None] * self._shape.change(line.angle - zero)
            line = fit_line(points[self._fin], fin)
        alpha = line.angle - zero
        return _Seen(trace, line, self._shape.fit(points, weight, alpha, self._span), alpha)

    def _weigh(self, seen: _Seen) -> tuple[float, float]:
        """Return the fin angle and its half-width of a 95 % interval [rad].

        Waves turn the line through the fin, and move the whole midline less. A fin that bends
        differs from the learned shape, but remains smooth: then only its line is used.
        """
        line = seen.line.residual / self._fin_length
        differs = seen.alpha - seen.fit.alpha
        if self._last is None:
            self._waves = line**2
        self._waves += 0.1 * (line**2 - self._waves)
        self._spread += 0.1 * (differs**2 - self._spread)
        part = min(1.0, _WAVE_GAIN**2 * self._waves / max(self._spread, _MIN_WAVE_RAD**2))
        spread = max(2.0 * math.sqrt(self._spread), abs(differs))
        of_line = math.hypot(spread, 3.5 * line)
        of_shape = _SHAPE_GAIN * seen.fit.alpha_error
        uncertainty = math.hypot((1.0 - part) * of_line, part * of_shape, 5e-4)
        return seen.alpha - part * differs, uncertainty

    def _find_fault(
        self,
        seen: _Seen | None,
        small: Pixels,
        light: Floats,
        cover: Floats,
        places: Array,
        time: float,
    ) -> str:
        """Return why the angle is unknown; empty if it is known."""
        place = self._find_foreign(small, cover, places)
        moved = self._watch_zero(None if place else seen, time)
        if seen is not None and seen.trace.length < _MIN_LENGTH * self.learned.length:
            side = cut_off_side(self._pose.to_picture(seen.trace.path), self.learned.size)
            return _leaves(side) if side else moved or "no tail where it was learned"
        if side := cut_off_side(places, self.learned.size):
            return _leaves(side)
        if moved := moved or self._watch_scene(place is not None, small, light, time):
            if 0.0 <= time - self._moved[0] <= _DOUBT_S:  # one picture alone may be wrong
                self._moved_until = time + _MOVED_S
            self._moved = time, moved
            return moved
        if place is not None:
            return f"something else moves near column {place[0]}, row {place[1]}"
        if seen is None:
            return self._find_lamp(small, places) or "too little of the fin is seen"
        differs = abs(seen.alpha - seen.fit.alpha) > self._max_difference
        is_distant = self._is_distant(seen.fit.error, time)
        is_other = differs or is_distant or self._is_turned(seen.fit.turn)
        low, high = self._span if not is_other else self.learned.span
        if not low < seen.alpha < high:
            return (
                f"{1e3 * seen.alpha:.0f} mrad are beyond the swing that was learned: learn again "
                "with the waves that are measured"
            )
        if is_other:
            return self._find_lamp(small, places) or _OTHER_SHAPE
        if self._last is not None:
            before, angle = self._last
            limit = _JUMP_RAD + _JUMP_RATE * self.learned.top_rate * (time - before)
            if 0.0 < time - before < _JUMP_S and abs(seen.alpha - angle) > limit:
                return "the fin jumped, or something else looks like it"
        return self._moved[1] if self._moved[0] <= time < self._moved_until else ""

    def _watch_zero(self, seen: _Seen | None, time: float) -> str:
        """Return by how much the zero has moved, if it has."""
        turns = self._turns
        if turns and time < turns[-1][0]:
            turns.clear()
            self._zero_moved = ""
        if seen is not None and self._is_whole(seen):
            turns.append((time, seen.fit.turn, seen.alpha > 0.0))
        while turns and time - turns[0][0] > _KNOCK_S:
            turns.popleft()
        if len(recent := self._recent_turns(_KNOCK_S)) >= _MIN_KNOCK_READINGS:
            turn = float(np.median([turn for turn, _ in recent]))
            sides = [[turn for turn, is_side in recent if is_side is s] for s in (False, True)]
            if min(map(len, sides)) >= _MIN_SIDE_READINGS:
                # A shape that differs from the learned one turns each side by another angle.
                turn = min(turn, float(np.mean([np.median(side) for side in sides])), key=abs)
            self._zero_moved = _zero_moved(turn) if abs(turn) >= self._max_mean_turn else ""
        return self._zero_moved

    def _is_whole(self, seen: _Seen) -> bool:
        """Return whether the whole tail has the learned shape, perhaps turned."""
        low, high = self.learned.span
        is_seen = seen.trace.weight.mean() > 0.9 and low <= seen.alpha <= high
        return bool(is_seen and seen.fit.error_turned < self._max_recent_error)

    def _recent_turns(self, span: float) -> list[tuple[float, bool]]:
        """Return the turns of the latest time [s], and their sides; none if it has gaps."""
        turns = self._turns
        recent = [each for each in turns if each[0] >= turns[-1][0] - span]
        if not recent or recent[-1][0] - recent[0][0] < 0.6 * span:
            return []
        return [(turn, is_side) for _, turn, is_side in recent]

    def _is_distant(self, error: float, time: float) -> bool:
        """Return whether a midline is far from the learned shape, or were those just before it."""
        errors = self._errors
        errors.append((time, min(error, self._max_error)))  # not spoilt by a bubble
        while not 0.0 <= time - errors[0][0] <= _DOUBT_S:
            errors.popleft()
        recent = float(np.mean([each for _, each in errors]))
        is_doubtful = len(errors) >= _MIN_DOUBT_READINGS and recent > self._max_recent_error
        return error > self._max_error or is_doubtful

    def _is_turned(self, turn: float) -> bool:
        """Return whether a midline is turned too much, or were those just before it."""
        recent = [turn for turn, _ in self._recent_turns(_DOUBT_S)]
        mean = abs(np.mean(recent)) if len(recent) >= _MIN_DOUBT_READINGS else 0.0
        return bool(abs(turn) > self._max_turn or mean > self._max_recent_turn)

    def _watch_scene(self, is_foreign: bool, small: Pixels, light: Floats, time: float) -> str:
        """Return how the camera has moved, if what stands still in the picture has.

        Where something else is seen, it must be what a move of the camera explains.
        """
        unit = np.array([self._ground.scale, self._ground.scale, 1.0])
        pose, _ = self._scene.find_pose(small, light)
        if np.all(np.abs(unit * pose) <= self._max_pose):
            self._poses.clear()
            return ""
        if not self._poses or not 0.0 <= time - self._scene_searched < _SCENE_S:
            self._scene_searched = time
            pose, agreement = self._scene.find_pose(small, light, _SCENE_STEPS)
            undone = self._scene.undo(small, pose).astype(np.uint8)
            before, after = self._count_foreign(small), self._count_foreign(undone)
            if agreement > _MAX_DISAGREEMENT or (is_foreign and after > _MAX_UNEXPLAINED * before):
                self._poses.clear()
                return ""
            self._poses.append(unit * pose)
        mean = np.mean(self._poses, axis=0)
        turn = float(mean[2])
        if abs(turn) > max(_KNOCK_RAD, self._max_pose[2] / math.sqrt(len(self._poses))):
            return _zero_moved(turn)
        part = np.abs(mean[:2]) / self._max_pose[:2]
        seen = mean[:2] * (part >= 0.5 * part.max())  # not what edges along the rows cannot show
        return f"the camera has moved by {math.hypot(*seen):.0f} px: learn again"

    def _count_foreign(self, small: Pixels) -> int:
        """Return how many pixels that the tail never covers differ from the background."""
        cover = self._ground.cover(small, self._ground.light(small))
        return int(np.count_nonzero((np.abs(cover) > _FOREIGN_LEVEL) & self._ground.still))

    def _find_foreign(self, small: Pixels, cover: Floats, places: Array) -> tuple[int, int] | None:
        """Return the column and row of something else that covers the ground."""
        foreign = (np.abs(cover) > _FOREIGN_LEVEL) & (small < SATURATED)
        foreign &= ~self._enclose(places, small.shape)
        return self._locate(foreign, _MAX_FOREIGN * foreign.size)

    def _locate(self, mask: Mask, least: float) -> tuple[int, int] | None:
        """Return the median column and row of pixels; None for fewer than `least`."""
        rows, columns = np.nonzero(mask)
        if len(rows) < least:
            return None
        x, y = (round(float(np.median(part)) * self._ground.scale) for part in (columns, rows))
        return x, y

    def _enclose(self, places: Array, shape: tuple[int, ...]) -> Mask:
        """Return which pixels of the small picture the tail may cover, with room for blur."""
        tangent = np.gradient(places, axis=0)
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
        reach = (1.3 * self._half + 0.025 * self.learned.size[0])[:, None]
        normal = reach * np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        start, end = (
            places[:1] - reach[0] * tangent[:1],
            places[-1:] + 1.5 * reach[-1] * tangent[-1:],
        )
        middle = np.concatenate([start, places, end])
        normal = np.concatenate([normal[:1], normal, normal[-1:]])
        outline = np.concatenate([middle + normal, (middle - normal)[::-1]]) / self._ground.scale
        inside = np.zeros(shape, np.uint8)
        cv2.fillPoly(inside, [np.rint(16 * outline).astype(np.int32)], 1, shift=4)
        return inside > 0

    def _find_lamp(self, small: Pixels, places: Array) -> str:
        """Return where a lamp is mirrored on the tail; empty if none is."""
        if self._hides_lamps:
            return ""
        lamp = self._locate((small >= SATURATED) & self._enclose(places, small.shape), 4)
        return f"a lamp is mirrored on the tail at column {lamp[0]}, row {lamp[1]}" if lamp else ""


def _leaves(side: str) -> str:
    return f"the tail leaves the picture at the {side}"


def _zero_moved(turn: float) -> str:
    return f"the zero has moved by {1e3 * abs(turn):.0f} mrad: learn again"
