"""`fishctl calibrate servo`: trim, direction and limits by small steps.

A calibration that is tried out is used for as long as fishctl holds the lease of the fish. Without
the operator's yes at the end the previous calibration is used again, whatever happens.
"""

import math
import time
from typing import Any

import click
from msgspec.structs import replace

from fishd.cli.calibrate.servo_lease import leased
from fishd.cli.options import endpoint_option, take_option
from fishd.cli.output import echo
from fishd.cli.prompts import choose, input_interrupted
from fishd.client import Fish
from fishd.core import text
from fishd.core.calibration import ServoCalibration
from fishd.core.errors import Refused

TRIM_STEP = 5.0
"""[µs]"""
TEST_ANGLE = 0.1
"""Angle by which the direction is judged [rad]."""
LIMIT_STEP = 0.02
"""[rad]"""
WIDEST = math.pi
"""A soft limit that does not limit; what pulses can reach still does [rad]."""
SLOW_STEP = 0.02
"""The tail is moved by so much at a time [rad]."""
PAUSE = 0.1
"""Time between two of these [s]."""
STEPS = {"+": 1, "-": -1, "++": 5, "--": -5}
"""What the operator types, and how many steps that is."""
_REACHED = 1e-6
"""An angle is reached when it is off by less [rad]."""


class Tail:
    """The tail of a fish at rest, and the calibration of its servo that is being found.

    fishd uses it for as long as the lease lasts; see `fishd.cli.calibrate.servo_lease`.
    """

    def __init__(self, fish: Fish, calibration: ServoCalibration) -> None:
        self.calibration = calibration
        """What fishd uses now."""
        self.angle = 0.0
        """Where the tail is [rad]."""
        self.amplitude = fish.status().amplitude_limit
        """Φ [rad]"""
        self._fish = fish

    def begin_trial(self) -> None:
        """Let no other controller than `hold` become active from now on."""
        self._try(self.calibration)

    def adjust(self, **changes: Any) -> None:
        """Try out a changed calibration, not saved; one that fishd refuses is reported."""
        try:
            self._try(replace(self.calibration, **changes))
        except Refused as refusal:
            if refusal.code != "bad-arguments":
                raise
            echo(f"  no: {refusal}")

    def go(self, wanted: float) -> bool:
        """Move slowly to an angle [rad]; False where the tail can go no further than it is then."""
        wanted = max(-self.amplitude, min(self.amplitude, wanted))
        while abs(wanted - self.angle) > _REACHED:
            step = max(-SLOW_STEP, min(SLOW_STEP, wanted - self.angle))
            target = round(self.angle + step, 9)
            state = self._fish.set_controller("hold", angle=target)
            self.angle = self._settled(target, state.seq)
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
        state = self._fish.stop()
        self.angle = self._settled(0.0, state.seq)

    def _try(self, calibration: ServoCalibration) -> None:
        """Let fishd use a calibration; raises `click.ClickException` while it is in fault."""
        status = self._fish.status()
        if status.reason:
            raise click.ClickException(
                f"fishd is in {status.mode}: {status.reason.message}; mend the cause, then clear "
                "it with 'fishctl clear-fault'"
            )
        self._fish.calibrate_servo(calibration, save=False)
        self.calibration = calibration

    def _settled(self, target: float, first: int) -> float:
        """Wait until the instruction angle is `target`, or stands still elsewhere; returns it.

        first: number of the first tick that knows of the target; telemetry may lag behind answers,
            and in a tick from before the tail stands still where it was
        """
        angle = math.nan
        for tick in self._fish.ticks():
            if tick.seq < first:
                continue
            previous, angle = angle, tick.phi_c
            if abs(angle - target) < _REACHED or angle == previous:
                break
        return angle


@click.command()
@endpoint_option
@take_option
def servo(endpoint: str | None) -> None:
    """Find the servo's trim, direction and limits by small steps.

    Watch the tail meanwhile. A positive angle moves it to the fish's left. The fish must be at
    rest. Nothing is saved before you say yes; on Ctrl-C or any error the previous calibration is
    in use again.
    """
    with Fish(endpoint) as fish, input_interrupted():
        before = fish.calibrations().servo
        tail = Tail(fish, before)
        with leased(fish, before, tail.begin_trial) as lease:
            echo("Keep hands and cables clear of the tail. Ctrl-C stops it at any prompt.")
            _find_trim(tail)
            _find_direction(tail)
            _find_limit(tail, +1)
            _find_limit(tail, -1)
            _show(before, tail.calibration)
            if not click.confirm("Save it?"):
                raise click.ClickException("not saved")
            lease.when_lost = lambda: None
            saved = fish.calibrate_servo(tail.calibration, save=True)
    echo(text.line(f"in use, and saved in {saved.servo_file}"))


def _find_trim(tail: Tail) -> None:
    echo(
        f"\nTrim: + and - turn the tail by {TRIM_STEP:g} µs, ++ and -- by {5 * TRIM_STEP:g} µs; "
        "ok when it is straight."
    )
    tail.neutral()
    while True:
        word = choose(f"trim {tail.calibration.trim:+g} µs", *STEPS, "ok", suffix="> ")
        if word == "ok":
            return
        tail.adjust(trim=tail.calibration.trim + TRIM_STEP * STEPS[word])


def _find_direction(tail: Tail) -> None:
    echo(f"\nDirection: the tail moves by {TEST_ANGLE:g} rad, slowly, and stays there.")
    answer = "a"
    while answer != "y":
        tail.go(TEST_ANGLE)
        question = "Did it move to the fish's left? y, n, or a for again"
        answer = choose(question, "y", "n", "a")
        tail.neutral()
        if answer == "n":
            was = tail.calibration
            # The stops of the mechanics stay where they are, on the other side of neutral.
            tail.adjust(
                direction=-was.direction, lowest=0.0 - was.highest, highest=0.0 - was.lowest
            )
            echo("The direction is turned round; once more, to be sure.")


def _find_limit(tail: Tail, side: int) -> None:
    """Find the limit to the fish's left (1) or right (-1)."""
    key, where = ("highest", "left") if side > 0 else ("lowest", "right")
    was = getattr(tail.calibration, key)
    echo(
        f"\nLimit to the fish's {where}: + goes {LIMIT_STEP:g} rad further and - back, ++ and -- "
        f"{5 * LIMIT_STEP:g} rad; ok where it may go no further, keep for {was:+g} rad as it was."
    )
    tail.adjust(**{key: side * WIDEST})
    end = abs(tail.reach[side > 0])
    limit = was
    while True:
        word = choose(f"{key} {tail.angle:+.2f} rad", *STEPS, "ok", "keep", suffix="> ")
        if word in STEPS:
            wanted = max(0.0, side * tail.angle + LIMIT_STEP * STEPS[word])
            if not tail.go(side * wanted):
                echo("  no further: the pulses of a servo end here")
            elif wanted > tail.amplitude:
                echo("  no further: this is amplitude_limit")
        elif word == "ok" and tail.angle == 0.0:
            echo("  the tail could not go this way at all; go to its limit first, or keep")
        elif word == "ok" and side * tail.angle >= tail.amplitude and side * was > tail.amplitude:
            # No stop was found, so a limit that lies beyond is not to be lost.
            echo(f"  free as far as amplitude_limit; {key} stays at {was:+g} rad")
            break
        else:
            limit = round(tail.angle, 4) if word == "ok" else was
            break
    if end < tail.amplitude and abs(limit) > end:
        limit = side * math.floor(end * 1e4) / 1e4
        echo(f"  {key} is {limit:+g} rad now, where the pulses of a servo end")
    tail.neutral()
    tail.adjust(**{key: limit})


def _show(before: ServoCalibration, now: ServoCalibration) -> None:
    units = {"trim": "µs", "direction": "±1", "scale": "µs/rad", "lowest": "rad", "highest": "rad"}
    echo(f"\n{'':<16}{'before':>10}{'now':>10}")
    for name, unit in units.items():
        old, new = getattr(before, name), getattr(now, name)
        echo(f"{f'{name} [{unit}]':<16}{old:>+10g}{new:>+10g}")
