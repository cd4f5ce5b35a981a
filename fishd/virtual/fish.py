"""Simulated fish behind the protocols of real hardware.

It advances at each read, by the time since the previous read, under the latest instruction angle.
It does not use a clock, and therefore runs in real time and in virtual time.
"""

import math
from collections.abc import Mapping
from typing import ClassVar

from fishd.core.calibration import ForceCalibration
from fishd.core.schema import Reading
from fishd.core.signals import Measurement, Truth
from fishd.hardware.base import Robot
from fishd.hardware.driver import Pair
from fishd.hardware.force_sensor.window import VoltageWatch
from fishd.hardware.settings import POWER
from fishd.virtual.imperfections import Imperfections, SimulationSettings
from fishd.virtual.plant.base import PlantWindow, TrueWindow, Window
from fishd.virtual.plant.parameters import TETHERED, PlantParameters
from fishd.virtual.plant.registry import open_plant


class ModelPower:
    """The power meter of a simulated servo: the model of its motor."""

    name = "power"
    declared: ClassVar[Mapping[str, Reading]] = {"power": POWER}
    required, stale_after = False, math.inf
    doubts: ClassVar[Mapping[str, str]] = {}
    trouble = None

    def __init__(self, fish: "SimulatedFish") -> None:
        self._fish = fish

    def read(self) -> dict[str, tuple[float, float]]:
        """Return time and power of the latest window; nothing for a fish without a motor."""
        power = self._fish.power()
        return {"power": (self._fish.time or 0.0, power)} if math.isfinite(power) else {}


class SimulatedFish:
    """Force sensor and servo of a simulated tethered fish."""

    def __init__(self, plant: PlantParameters, settings: SimulationSettings, tick: float) -> None:
        """`tick` is the period of the loop [s]; the first read covers one period."""
        self.fish = open_plant(plant, settings.motor)
        self.window: Window = PlantWindow(tick, 0.0, 0.0, 0.0, 0.0, 0.0)
        """Latest window with its true mean forces; zero before the first read."""
        self._power: float | None = None
        """Mean power in the latest window [W]; None until it is read."""
        self._imperfections = Imperfections(settings, tick)
        self._sample_rate = settings.sample_rate
        self._tick = tick
        self.time: float | None = None
        """Time of the latest read [s]; None before the first one."""
        self._start = 0.0
        self._duration, self._samples = 0.0, 1
        """Length of the latest window [s], and its number of samples."""
        self._instruction_angle: float | None = None
        self._fin_speed = 0.0
        self.calibration = ForceCalibration()
        """Calibration between the forces of the rig and those of measurements; a tare sets it."""
        self.unit = "N"
        self._watches: list[VoltageWatch] = []

    def read(self, now: float) -> Measurement:
        """Advance to `now` [s] and return the forces of this window."""
        if self.time is None:
            self._start = self.time = now - self._tick
        duration = round(now - self.time, 9)
        self.time = now
        if duration != self._duration:
            self._duration, self._samples = duration, round(self._sample_rate * duration) or 1
        samples = self._samples
        self.window = window = self.fish.advance(self._instruction_angle, duration, samples)
        self._power = None
        fx, fy = window.sampled_thrust, window.sampled_lateral_force
        fx, fy = self._imperfections.apply(fx, fy, now - self._start, duration, samples)
        if self._watches:
            self._watches = [watch for watch in self._watches if not watch.closed]
            for watch in self._watches:
                watch.add([Pair(now - duration, now, fx, fy)], None)
        fx, fy = self.calibration.forces(fx, fy)
        newest, mean_time = now - 0.5 * duration / samples, now - 0.5 * duration
        return Measurement(newest, fx, fy, samples, mean_time=mean_time, span=duration)

    def recalibrate(self, calibration: ForceCalibration) -> None:
        """Use another zero from the next read on, for the lifetime of this object."""
        self.calibration = calibration

    def watch(self) -> VoltageWatch:
        """Return a watch that adds up the forces of every window from now on."""
        watch = VoltageWatch(self.time or 0.0, self.calibration)
        self._watches.append(watch)
        return watch

    def take_window(self) -> TrueWindow:
        """Return the true motion and forces between the latest two reads."""
        window, state = self.window, self.fish.state
        turned = self._fin_speed * state.alpha_rate <= 0.0
        self._fin_speed = state.alpha_rate
        # A fin that has not reversed has its largest angle at the end of the window.
        peak = window.fin_peak if turned else abs(state.alpha)
        # The loop has usually read the power already.
        return TrueWindow(window.duration, window.thrust, peak, self._power or self.power())

    def power(self) -> float:
        """Return the mean electrical power of the servo over the latest window [W]."""
        if self._power is None:
            self._power = self.window.power
        return self._power

    def write(self, instruction_angle: float) -> None:
        """Set the instruction angle [rad] from the latest read onwards."""
        self._instruction_angle = instruction_angle

    def release(self) -> None:
        """Stop the pulses; the wheel keeps its angle."""
        self._instruction_angle = None

    def close(self) -> None:
        """Release the servo."""
        self.release()

    def truth(self) -> Truth:
        """Return the true state at the latest read."""
        state = self.fish.state
        return Truth(alpha=state.alpha, alpha_rate=state.alpha_rate, phi=state.phi)

    def robot(self) -> Robot:
        """Return the robot of the loop, with a power meter if the fish has a motor."""
        return Robot(
            name="simulated",
            sensor=self,
            servo=self,
            truth=self.truth,
            tared=self,
            sensors=(ModelPower(self),) if self.fish.parameters.model == TETHERED else (),
        )
