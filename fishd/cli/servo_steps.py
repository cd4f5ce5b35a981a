"""What `fishctl calibrate servo` is made of: a tail that moves slowly, and orders at a prompt."""

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import click
from msgspec.structs import replace

from fishd.cli.output import echo
from fishd.client import Fish
from fishd.errors import Refused
from fishd.hardware.calibration import ServoCalibration

SLOW_STEP = 0.02
"""The tail is moved by so much at a time [rad]."""
PAUSE = 0.1
"""Time between two of these [s]."""
_REACHED = 1e-6
"""An angle is reached when it is off by less [rad]."""
_STEPS = {"+": 1, "-": -1, "++": 5, "--": -5}


class Tail:
    """The tail of a fish at rest, and the calibration of its servo that is being found.

    What is found is in force for a loan; see `fishd.cli.servo_loan`.
    """

    def __init__(self, fish: Fish, calibration: ServoCalibration) -> None:
        self.calibration = calibration
        """What is in force now."""
        self.loan = ""
        self.angle = 0.0
        """Where the tail is [rad]."""
        status = fish.status()
        self.amplitude = status.amplitude_limit
        """Φ [rad]"""
        self._tick = status.tick
        self._fish = fish

    def check_resting(self) -> None:
        """Raises `click.ClickException` unless the servo has pulses and nothing else moves it."""
        status = self._fish.status()
        if status.reason:
            raise click.ClickException(
                f"fishd is in {status.mode}: {status.reason.message}; mend the cause, then clear "
                "it with 'fishctl clear-fault'"
            )
        if status.mode == "running" and status.controller != "hold":
            raise click.ClickException(
                f"{status.controller} is in command; stop it with 'fishctl stop'"
            )

    def borrow(self) -> None:
        """Begin the loan: nobody else calibrates the servo, or makes the fish swim, meanwhile."""
        self.check_resting()
        self.loan = self._fish.calibrate_servo(self.calibration, save=False).loan or ""

    def adjust(self, **changes: Any) -> None:
        """Put a changed calibration in force, not saved; what cannot be is shown and left out."""
        self.check_resting()
        changed = replace(self.calibration, **changes)
        try:
            self._fish.calibrate_servo(changed, save=False, loan=self.loan)
        except Refused as refusal:
            if refusal.code != "bad-arguments":
                raise
            echo(f"  no: {refusal}")
        else:
            self.calibration = changed

    def go(self, wanted: float) -> bool:
        """Move slowly to an angle [rad]; False where the tail can go no further than it is then."""
        wanted = max(-self.amplitude, min(self.amplitude, wanted))
        while abs(wanted - self.angle) > _REACHED:
            self.check_resting()
            step = max(-SLOW_STEP, min(SLOW_STEP, wanted - self.angle))
            target = round(self.angle + step, 9)
            self._fish.set_controller("hold", angle=target)
            self.angle = self._settled(target)
            if abs(self.angle - target) > _REACHED:
                return False
            time.sleep(PAUSE)
        return True

    @property
    def reach(self) -> tuple[float, float]:
        """The lowest and highest angle that Φ, limits and pulses permit now [rad]."""
        status = self._fish.status()
        return status.lowest, status.highest

    def neutral(self) -> None:
        """Fade to neutral, and wait until the tail is there."""
        self._fish.stop()
        self.angle = self._settled(0.0)

    def _settled(self, target: float) -> float:
        """Wait until the instruction angle is `target`, or stands still elsewhere; returns it."""
        angle = math.nan
        for tick in self._fish.ticks():
            previous, angle = angle, tick.phi_c
            if abs(angle - target) < _REACHED or angle == previous:
                break
        return angle


def orders(state: Callable[[], str], *others: str) -> Iterator[int | str]:
    """Ask for ever at a prompt that shows `state`: yields a number of steps, 'ok' or another."""
    words = (*_STEPS, "ok", *others)
    while True:
        answer = click.prompt(state(), prompt_suffix="> ", default="", show_default=False).strip()
        if answer in words:
            yield _STEPS.get(answer, answer)
        else:
            echo(f"  one of {' '.join(words)} is needed; Ctrl-C leaves all as it was")
