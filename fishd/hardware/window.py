"""What the samples of one window amount to: forces and whether to believe them; voltages."""

import math
from collections.abc import Sequence

from fishd.hardware.calibration import ForceCalibration, ForceSample
from fishd.hardware.sampler import Pair
from fishd.hardware.settings import Channel, ForceSensorSettings
from fishd.signals import Extremes, Measurement

STEPS = 32768
"""Of the ADC, from zero to full scale."""


class Evaluation:
    """Turns pairs of codes into measurements of the forces."""

    def __init__(self, settings: ForceSensorSettings) -> None:
        self.step = settings.full_scale / STEPS
        """Voltage of one step of the ADC [V]."""
        self._limit = settings.force_limit
        self._x = _Channel("F_x", settings.channel_x, settings)
        self._y = _Channel("F_y", settings.channel_y, settings)

    def measure(self, pairs: Sequence[Pair], calibration: ForceCalibration) -> Measurement:
        """Means of at least one pair."""
        _, times, xs, ys = zip(*pairs, strict=True)
        scale = self.step / len(pairs)
        fx, fy = calibration.forces(sum(xs) * scale, sum(ys) * scale)
        newest = times[-1]
        # Both channels see every window, else one that is not asked could not tell that it froze.
        doubt_x, doubt_y = self._x.doubt(xs, newest), self._y.doubt(ys, newest)
        extremes = self._extremes(xs, ys, calibration)
        suspect = doubt_x or doubt_y or self._beyond_limit(extremes)
        return Measurement(newest, fx, fy, len(pairs), suspect, extremes)

    def interrupt(self) -> None:
        """Note that samples stopped coming in, so that nobody takes that for a frozen code."""
        self._x.forget()
        self._y.forget()

    def _extremes(
        self, xs: Sequence[int], ys: Sequence[int], calibration: ForceCalibration
    ) -> Extremes:
        step, forces = self.step, calibration.forces
        fxs, fys = zip(
            *[forces(x * step, y * step) for x, y in zip(xs, ys, strict=True)], strict=True
        )
        return Extremes(min(fxs), max(fxs), min(fys), max(fys))

    def _beyond_limit(self, found: Extremes) -> str:
        limit = self._limit
        for name, low, high in (
            ("F_x", found.fx_min, found.fx_max),
            ("F_y", found.fy_min, found.fy_max),
        ):
            if not (low >= -limit and high <= limit):
                force = high if high > limit else low
                return f"{name} is {force:+.4g} N, beyond force_sensor.force_limit, {limit:g} N"
        return ""


class _Channel:
    """One channel of the ADC, and whether its codes can be believed."""

    def __init__(self, force: str, channel: Channel, settings: ForceSensorSettings) -> None:
        self._name = f"{force} (channel {channel})"
        self._step = settings.full_scale / STEPS
        low, high = settings.saturation_low, settings.saturation_high
        self._lowest = -STEPS if low is None else max(-STEPS, math.floor(low / self._step))
        self._highest = STEPS - 1 if high is None else min(STEPS - 1, math.ceil(high / self._step))
        self._patience = math.inf if settings.frozen_after is None else settings.frozen_after
        self.forget()

    def forget(self) -> None:
        """Begin to watch anew for a frozen code."""
        self._code: int | None = None
        self._since = math.inf

    def doubt(self, codes: Sequence[int], newest: float) -> str:
        """Why not to believe these codes, empty if there is no reason; `newest` in seconds."""
        lowest, highest = min(codes), max(codes)
        if not lowest == highest == self._code:
            self._code = codes[-1]
            self._since = newest
        if highest >= self._highest:
            return self._at_its_end(highest, "saturation_high")
        if lowest <= self._lowest:
            return self._at_its_end(lowest, "saturation_low")
        still = newest - self._since
        if still >= self._patience:
            volts = lowest * self._step
            return f"{self._name} has been frozen at {volts:+.6g} V for {still:.1f} s"
        return ""

    def _at_its_end(self, code: int, key: str) -> str:
        """The ADC's own end of the range, or that of the amplifier before it."""
        if code in (-STEPS, STEPS - 1):
            return f"{self._name} is clipped at {math.copysign(self._step * STEPS, code):+g} V"
        volts = code * self._step
        return (
            f"{self._name} is at {volts:+.4g} V: the amplifier is at its end (force_sensor.{key})"
        )


class VoltageWatch:
    """The voltages of many windows, added up as codes, which is exact."""

    def __init__(self, begun: float, step: float, calibration: ForceCalibration) -> None:
        """Pairs from before `begun` [s, monotonic] do not count; `step` of the ADC in volts."""
        self.closed = False
        self._step = step
        self._calibration = calibration
        self._begun = self._newest = begun
        self._pairs = self._x = self._y = self._xx = self._yy = 0
        self._suspect = ""

    def add(self, pairs: Sequence[Pair], suspect: str) -> None:
        """Add a window, and why it is not to be believed."""
        for begun, time, x, y in pairs:
            if begun >= self._begun:
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
        scale = self._step / count
        vx, vy = self._x * scale, self._y * scale
        fx, fy = self._calibration.forces(vx, vy)
        return ForceSample(
            pairs=self._pairs,
            seconds=self._newest - self._begun,
            vx=vx,
            vy=vy,
            vx_std=math.sqrt(count * self._xx - self._x**2) * scale,
            vy_std=math.sqrt(count * self._yy - self._y**2) * scale,
            fx=fx,
            fy=fy,
            suspect=self._suspect,
        )
