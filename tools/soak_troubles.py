"""The trouble that `soak.py` makes: robots, controllers, subscribers and users that misbehave."""

import dataclasses
import math
import random
from collections import Counter
from collections.abc import Callable
from typing import Any

from fishd.controllers import registry
from fishd.controllers.base import Controller
from fishd.errors import FishdError, SensorError, ServoError
from fishd.hardware.base import Robot
from fishd.loop import ControlLoop
from fishd.signals import Event, Measurement, Observation, Tick


class BrokenPromise(BaseException):
    """What must never happen has happened; nothing in fishd may catch it."""


class Counting:
    """A publisher that keeps counts only, and fails now and then where it is told to."""

    def __init__(self, failing: Callable[[], bool] = lambda: False) -> None:
        self.reasons: Counter[str] = Counter()
        self._failing = failing

    def tick(self, tick: Tick) -> None:
        """Check, and drop."""
        if self._failing():
            raise ConnectionError("telemetry is gone")
        if abs(tick.phi_c) > 0.42 + 1e-9:
            raise BrokenPromise(f"tick {tick.seq} says {tick.phi_c} rad")

    def event(self, event: Event) -> None:
        """Count the faults."""
        if event.kind == "fault":
            self.reasons[event.data["code"]] += 1


class Saboteur:
    """A sensor and servo that fail in short bursts, each in its own way."""

    def __init__(self, robot: Robot, dice: random.Random) -> None:
        self._robot = robot
        self._dice = dice
        self._trouble = ""
        self._until = 0.0
        self.written = 0

    def robot(self) -> Robot:
        """The robot with this in between."""
        return dataclasses.replace(self._robot, sensor=self, servo=self)

    def read(self, now: float) -> Measurement:
        """Read, or fail."""
        measurement = self._robot.sensor.read(now)
        if now > self._until:
            self._trouble = ""
            if self._dice.random() < 0.004:
                kinds = ("silent", "bug", "stale", "suspect", "nan", "servo", "servo-bug")
                self._trouble = self._dice.choice(kinds)
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
        self._fail()
        self.written += 1
        self._robot.servo.write(angle)

    def release(self) -> None:
        """Release, or fail."""
        self._fail()
        self._robot.servo.release()

    def close(self) -> None:
        """Let go."""
        self._robot.servo.close()

    def _fail(self) -> None:
        if self._trouble == "servo":
            raise ServoError("pigpiod is gone")
        if self._trouble == "servo-bug":
            raise AttributeError("'NoneType' object has no attribute 'send'")


class Drunk(Controller[Any]):
    """A controller that does what none should."""

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
    """Ask the loop for something, as impatient users do."""
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
        pass  # refused, which is what a fault or an emergency stop does
