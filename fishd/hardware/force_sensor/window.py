"""Evaluation of the samples of a window: forces, reasons to suspect them, and mean voltages."""

import math
from collections.abc import Sequence

from fishd.core.calibration import ForceCalibration, ForceSample
from fishd.core.signals import Extremes, Measurement
from fishd.hardware.driver import Pair
from fishd.hardware.settings import ForceSensorSettings


class WindowEvaluation:
    """Evaluation of pairs of voltages as measurements of the forces."""

    def __init__(
        self, settings: ForceSensorSettings, names: tuple[str, str], raw_unit: str
    ) -> None:
        """Start without samples.

        names: names of the two channels in messages
        raw_unit: unit of the values of the pairs
        """
        self._limit = settings.force_limit
        self._raw_unit = raw_unit
        frozen_after = math.inf if settings.frozen_after is None else settings.frozen_after
        self._x, self._y = (_FrozenCodeDetector(name, frozen_after, raw_unit) for name in names)

    def measure(self, pairs: Sequence[Pair], calibration: ForceCalibration) -> Measurement:
        """Return the mean forces of at least one pair, with a reason if they are suspect."""
        begins, times, vxs, vys, clipped = zip(*pairs, strict=True)
        count, newest = len(pairs), times[-1]
        # Evenly spread over `span`, that many samples have the same variance in time as the true
        # ones, which are a quarter of the spacing from the middle of their pair.
        spacing = (newest - times[0]) / (count - 1) if count > 1 else newest - begins[0]
        span, weight = spacing * math.sqrt(count**2 + 0.75), 1.0 / count
        vx, vy, mean_time = sum(vxs), sum(vys), 0.5 * (sum(begins) + sum(times))
        if count % 2 and count > 1:
            # Pairs begin with x and y in turn. With half the weight of the first and of the last
            # pair, as in the trapezoidal rule, neither is later in the mean.
            span, weight = spacing * math.sqrt((count - 1) ** 2 + 3.6), 1.0 / (count - 1)
            vx -= 0.5 * (vxs[0] + vxs[-1])
            vy -= 0.5 * (vys[0] + vys[-1])
            mean_time -= 0.25 * (begins[0] + begins[-1] + times[0] + newest)
        fx, fy = calibration.forces(weight * vx, weight * vy)
        # Both detectors need every window, even if another reason makes this one suspect.
        frozen_x, frozen_y = self._x.check(vxs, newest), self._y.check(vys, newest)
        extremes = _extremes(vxs, vys, calibration)
        suspect = (
            next(filter(None, clipped), None)
            or frozen_x
            or frozen_y
            or self._beyond_limit(extremes, calibration)
        )
        return Measurement(
            newest, fx, fy, count, suspect, extremes, mean_time=weight * mean_time, span=span
        )

    def interrupt(self) -> None:
        """Restart the detection of frozen codes, because samples stopped arriving."""
        self._x.reset()
        self._y.reset()

    def unit(self, calibration: ForceCalibration) -> str:
        """Return the unit of the forces that this calibration gives."""
        return self._raw_unit if calibration.is_unset else "N"

    def _beyond_limit(self, extremes: Extremes, calibration: ForceCalibration) -> str | None:
        limit = self._limit
        for name, low, high in (
            ("F_x", extremes.fx_min, extremes.fx_max),
            ("F_y", extremes.fy_min, extremes.fy_max),
        ):
            if not (low >= -limit and high <= limit):
                force = high if high > limit else low
                reason = f"{name} is {force:+.4g} N, beyond force_sensor.force_limit, {limit:g} N"
                if calibration.is_unset:
                    reason += f" (not calibrated: 1 {self._raw_unit} counts as 1 N)"
                return reason
        return None


def _extremes(
    vxs: Sequence[float], vys: Sequence[float], calibration: ForceCalibration
) -> Extremes:
    forces = calibration.forces
    fxs, fys = zip(*[forces(vx, vy) for vx, vy in zip(vxs, vys, strict=True)], strict=True)
    return Extremes(min(fxs), max(fxs), min(fys), max(fys))


class _FrozenCodeDetector:
    """Detector of a channel whose code has not changed for too long."""

    def __init__(self, name: str, frozen_after: float, unit: str) -> None:
        self._name = name
        self._unit = unit
        self._frozen_after = frozen_after
        self.reset()

    def reset(self) -> None:
        """Forget the last code."""
        self._value: float | None = None
        self._since = math.inf

    def check(self, values: Sequence[float], newest: float) -> str | None:
        """Return why the values are suspect; None if they are not.

        newest: time of the last value [s, monotonic]
        """
        last = values[-1]
        if not min(values) == max(values) == self._value:
            self._value = last
            self._since = newest
        unchanged = newest - self._since
        if unchanged < self._frozen_after:
            return None
        return f"{self._name} has been frozen at {last:+.6g} {self._unit} for {unchanged:.1f} s"


class VoltageWatch:
    """Sum of the voltages of many windows."""

    def __init__(self, started: float, calibration: ForceCalibration) -> None:
        """Start a sum; pairs from before `started` [s, monotonic] do not count."""
        self.closed = False
        self._calibration = calibration
        self._started = self._newest = started
        self._pairs = 0
        # Sums of differences from the first pair: so their squares lose no digits.
        self._origin = (0.0, 0.0)
        self._x = self._y = self._xx = self._yy = 0.0
        self._suspect: str | None = None

    def add(self, pairs: Sequence[Pair], suspect: str | None) -> None:
        """Add the pairs of a window, and the reason why it is suspect, if it is."""
        for started, time, vx, vy, _ in pairs:
            if started >= self._started:
                if not self._pairs:
                    self._origin = vx, vy
                x, y = vx - self._origin[0], vy - self._origin[1]
                self._newest = time
                self._pairs += 1
                self._x += x
                self._y += y
                self._xx += x * x
                self._yy += y * y
        self._suspect = self._suspect or suspect

    def close(self) -> ForceSample:
        """Stop and return the sample, all zero if no pair arrived; may be called twice."""
        self.closed = True
        count = max(self._pairs, 1)
        x, y = self._x / count, self._y / count
        vx, vy = self._origin[0] + x, self._origin[1] + y
        fx, fy = self._calibration.forces(vx, vy)
        return ForceSample(
            pairs=self._pairs,
            seconds=self._newest - self._started,
            vx=vx,
            vy=vy,
            vx_std=math.sqrt(max(0.0, self._xx / count - x * x)),
            vy_std=math.sqrt(max(0.0, self._yy / count - y * y)),
            fx=fx,
            fy=fy,
            suspect=self._suspect,
        )
