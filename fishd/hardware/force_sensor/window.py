"""What the samples of one window amount to: forces and whether to believe them; voltages."""

import math
from collections.abc import Sequence

from fishd.core.calibration import ForceCalibration, ForceSample
from fishd.core.signals import Extremes, Measurement
from fishd.hardware.driver import Pair
from fishd.hardware.settings import ForceSensorSettings


class WindowEvaluation:
    """Turns pairs of voltages into measurements of the forces."""

    def __init__(
        self, settings: ForceSensorSettings, names: tuple[str, str], raw_unit: str
    ) -> None:
        """names: what messages call the two channels; raw_unit: that of the pairs"""
        self._limit = settings.force_limit
        self._raw_unit = raw_unit
        patience = math.inf if settings.frozen_after is None else settings.frozen_after
        self._x, self._y = (_FrozenCode(name, patience, raw_unit) for name in names)

    def measure(self, pairs: Sequence[Pair], calibration: ForceCalibration) -> Measurement:
        """Means of at least one pair."""
        _, times, vxs, vys, clipped = zip(*pairs, strict=True)
        count = len(pairs)
        fx, fy = calibration.forces(sum(vxs) / count, sum(vys) / count)
        newest = times[-1]
        # Both channels see every window, else one that is not asked could not tell that it froze.
        frozen_x, frozen_y = self._x.doubt(vxs, newest), self._y.doubt(vys, newest)
        extremes = _extremes(vxs, vys, calibration)
        suspect = (
            next(filter(None, clipped), "")
            or frozen_x
            or frozen_y
            or self._beyond_limit(extremes, calibration)
        )
        return Measurement(newest, fx, fy, count, suspect, extremes)

    def interrupt(self) -> None:
        """Note that samples stopped coming in, so that nobody takes that for a frozen code."""
        self._x.forget()
        self._y.forget()

    def unit(self, calibration: ForceCalibration) -> str:
        """Of the forces that this calibration gives."""
        return self._raw_unit if calibration.untouched else "N"

    def _beyond_limit(self, found: Extremes, calibration: ForceCalibration) -> str:
        limit = self._limit
        for name, low, high in (
            ("F_x", found.fx_min, found.fx_max),
            ("F_y", found.fy_min, found.fy_max),
        ):
            if not (low >= -limit and high <= limit):
                force = high if high > limit else low
                said = f"{name} is {force:+.4g} N, beyond force_sensor.force_limit, {limit:g} N"
                if calibration.untouched:
                    said += f" (not calibrated: 1 {self._raw_unit} counts as 1 N)"
                return said
        return ""


def _extremes(
    vxs: Sequence[float], vys: Sequence[float], calibration: ForceCalibration
) -> Extremes:
    forces = calibration.forces
    fxs, fys = zip(*[forces(vx, vy) for vx, vy in zip(vxs, vys, strict=True)], strict=True)
    return Extremes(min(fxs), max(fxs), min(fys), max(fys))


class _FrozenCode:
    """Whether one channel says the same for too long."""

    def __init__(self, name: str, patience: float, unit: str) -> None:
        self._name = name
        self._unit = unit
        self._patience = patience
        self.forget()

    def forget(self) -> None:
        """Begin to watch anew."""
        self._value: float | None = None
        self._since = math.inf

    def doubt(self, values: Sequence[float], newest: float) -> str:
        """Why not to believe these, empty if there is no reason; `newest` in seconds."""
        last = values[-1]
        if not min(values) == max(values) == self._value:
            self._value = last
            self._since = newest
        still = newest - self._since
        if still < self._patience:
            return ""
        return f"{self._name} has been frozen at {last:+.6g} {self._unit} for {still:.1f} s"


class VoltageWatch:
    """The voltages of many windows, added up."""

    def __init__(self, begun: float, calibration: ForceCalibration) -> None:
        """Pairs from before `begun` [s, monotonic] do not count."""
        self.closed = False
        self._calibration = calibration
        self._begun = self._newest = begun
        self._pairs = 0
        # Sums of what is beyond the first pair: so their squares lose no digits.
        self._origin = (0.0, 0.0)
        self._x = self._y = self._xx = self._yy = 0.0
        self._suspect = ""

    def add(self, pairs: Sequence[Pair], suspect: str) -> None:
        """Add a window, and why it is not to be believed."""
        for begun, time, vx, vy, _ in pairs:
            if begun >= self._begun:
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
        """Stop, and say what came in, all zero if nothing did; may be called twice."""
        self.closed = True
        count = max(self._pairs, 1)
        x, y = self._x / count, self._y / count
        vx, vy = self._origin[0] + x, self._origin[1] + y
        fx, fy = self._calibration.forces(vx, vy)
        return ForceSample(
            pairs=self._pairs,
            seconds=self._newest - self._begun,
            vx=vx,
            vy=vy,
            vx_std=math.sqrt(max(0.0, self._xx / count - x * x)),
            vy_std=math.sqrt(max(0.0, self._yy / count - y * y)),
            fx=fx,
            fy=fy,
            suspect=self._suspect,
        )
