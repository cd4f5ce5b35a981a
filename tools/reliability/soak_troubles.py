"""Misbehaving robots, controllers, subscribers and users of `soak`."""

import dataclasses
import itertools
import math
import random
from collections import Counter
from collections.abc import Callable
from typing import Any

from common.report import BrokenPromise
from fishd.control.loop import ControlLoop
from fishd.control.supervisor import Mode
from fishd.controllers import registry
from fishd.controllers.base import Controller
from fishd.core.errors import FishdError, SensorError, ServoError
from fishd.core.signals import Event, Measurement, Observation, Reason, Tick
from fishd.hardware.base import Robot


class Counting:
    """Publisher that only counts, and fails occasionally if requested."""

    def __init__(self, failing: Callable[[], bool] = lambda: False) -> None:
        self.reasons: Counter[str] = Counter()
        self._failing = failing

    def tick(self, tick: Tick) -> None:
        """Check the tick."""
        if self._failing():
            raise ConnectionError("telemetry is gone")
        if abs(tick.phi_c) > 0.42 + 1e-9:
            raise BrokenPromise(f"tick {tick.seq} says {tick.phi_c} rad")

    def event(self, event: Event) -> None:
        """Count the faults."""
        if event.kind == "fault":
            self.reasons[event.data["code"]] += 1


class Saboteur:
    """Sensor and servo that fail in short bursts, each in a different way."""

    def __init__(self, robot: Robot, dice: random.Random) -> None:
        self._robot = robot
        self._dice = dice
        self._trouble = ""
        self._until = 0.0
        self._failing: tuple[str, ...] = ()
        self._victims = itertools.cycle((("write", "release"), ("release",), ("write",)))
        self.servo_on = False
        """Whether the latest successful call of the servo was a write, not a release."""

    def robot(self) -> Robot:
        """Return the robot with the failures of this object."""
        return dataclasses.replace(self._robot, sensor=self, servo=self)

    @property
    def in_trouble(self) -> bool:
        """Return whether the servo cannot be written or released."""
        return self._trouble.startswith("servo")

    def read(self, now: float) -> Measurement:
        """Read, or fail."""
        measurement = self._robot.sensor.read(now)
        if now > self._until:
            self._trouble = ""
            if self._dice.random() < 0.004:
                kinds = ("silent", "bug", "stale", "suspect", "nan", "servo", "servo-bug")
                self._trouble = self._dice.choice(kinds)
                self._failing = next(self._victims)
                self._until = now + self._dice.uniform(0.0, 0.4)
        match self._trouble:
            case "silent":
                raise SensorError("no acknowledge")
            case "bug":
                raise ZeroDivisionError
            case "stale":
                return Measurement(measurement.time - 1.0, 0.0, 0.0, 1)
            case "suspect":
                return Measurement(measurement.time, 9.0, 9.0, 1, "F_x is clipped")
            case "nan":
                return Measurement(measurement.time, math.nan, 0.0, 1)
        return measurement

    def write(self, angle: float) -> None:
        """Write, or fail."""
        if not abs(angle) <= 0.42 + 1e-9:
            raise BrokenPromise(f"the servo was sent {angle} rad")
        self._fail("write")
        self._robot.servo.write(angle)
        self.servo_on = True

    def release(self) -> None:
        """Release, or fail."""
        self._fail("release")
        self._robot.servo.release()
        self.servo_on = False

    def close(self) -> None:
        """Release the robot."""
        self._robot.servo.close()

    def _fail(self, action: str) -> None:
        if action not in self._failing:
            return
        if self._trouble == "servo":
            raise ServoError("pigpiod is gone")
        if self._trouble == "servo-bug":
            raise AttributeError("'NoneType' object has no attribute 'send'")


class Rest:
    """Check that pulses end in fault and estop as soon as the servo can be reached."""

    LIMITS = {Mode.ESTOP: 10, Mode.FAULT: 12}  # noqa: RUF012 - never changed
    """Ticks that may pass before; a fault first fades to neutral."""

    def __init__(self, loop: ControlLoop, patience: int = 0) -> None:
        """`patience`: ticks until a lost servo must return."""
        self._loop = loop
        self._patience = patience
        self._reason: Reason | None = None
        self._ticks = 0

    def check(self, in_trouble: bool, servo_on: bool) -> None:
        """Check a tick: whether the servo cannot be reached, and whether it has pulses."""
        loop = self._loop
        reason = loop.supervisor.reason
        if in_trouble or reason is None or reason is not self._reason:
            self._ticks = 0
        self._reason = reason
        self._ticks += 1
        mode = loop.supervisor.mode
        late = self._ticks > self.LIMITS.get(mode, math.inf) + self._patience
        if late and (servo_on or loop.servo.on):
            raise BrokenPromise(f"tick {loop.seq}: {self._ticks} ticks in {mode}, and still pulses")


class Drunk(Controller[Any]):
    """Controller that misbehaves."""

    def __init__(self, dice: random.Random, loop: ControlLoop) -> None:
        parameters = registry.create("hold", {}, loop.limits).parameters
        super().__init__(parameters, loop.limits)
        self._dice = dice

    def update(self, observation: Observation) -> float:
        """Return a wild angle, or worse."""
        what = self._dice.random()
        if what < 0.01:
            raise RuntimeError("hiccup")
        if what < 0.02:
            return self._dice.choice((math.nan, math.inf, -math.inf))
        if what < 0.03:
            return None  # type: ignore[return-value]
        return self._dice.gauss(0.0, 10.0)


def misuse(loop: ControlLoop, dice: random.Random) -> None:
    """Send random requests to the loop, like an impatient user."""
    name = dice.choice(("square", "sine", "triangle", "swing", "hold", "drunk"))
    try:
        match dice.randrange(8):
            case 0 | 1 | 2 | 3:
                controller: Controller[Any]
                if name == "drunk":
                    controller = Drunk(dice, loop)
                else:
                    controller = registry.create(name, {}, loop.limits)
                loop.set_controller(name, controller)
            case 4:
                loop.stop()
            case 5:
                loop.estop("soak")
            case _:
                loop.clear_fault()
    except FishdError:
        pass  # refused during a fault or an emergency stop
