"""`fishctl calibrate servo`: trim, direction and limits by small steps.

fishd uses a calibration on trial while fishctl holds the lease of the fish. Unless the operator
confirms it at the end, the previous calibration is used again.
"""

import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import click
from msgspec.structs import replace

from fishd.cli.options import endpoint_option, take_option, verb_lease
from fishd.cli.output import echo
from fishd.cli.prompts import choose, input_interrupted
from fishd.client import Fish
from fishd.client.lease import LeaseRenewal
from fishd.core import text
from fishd.core.calibration import ServoCalibration
from fishd.core.errors import FishError, Refused
from fishd.core.protocol import Calibrations
from fishd.core.signals import Status

TRIM_STEP = 5.0
"""Change of the trim at each step [µs]."""
TEST_ANGLE = 0.1
"""Angle of the tail in the test of the direction [rad]."""
LIMIT_STEP = 0.02
"""Change of the angle at each step towards a limit [rad]."""
NO_LIMIT = math.pi
"""Soft limit beyond the range of the pulses, so that it has no effect [rad]."""
MAX_MOVE_RAD = 0.02
"""Largest change of the angle in one slow movement [rad]."""
MOVE_INTERVAL_S = 0.1
"""Time between two such movements [s]."""
STEPS = {"+": 1, "-": -1, "++": 5, "--": -5}
"""Number of steps of each word that the operator types."""
_ANGLE_TOLERANCE_RAD = 1e-6
"""Tolerance of an angle that counts as reached [rad]."""
_POLL_INTERVAL_S = 0.1
"""Time between two requests for the state of fishd [s]."""
_NEUTRAL_TIMEOUT_S = 15.0
"""Longest time for the tail to reach neutral [s]."""
_ESTOP_TIMEOUT_S = 2.0
"""Longest time for the end of a lease in mode estop, where the tail may stay in place [s]."""


class Tail:
    """Tail of a fish at rest, and the trial calibration of its servo.

    fishd uses the calibration while the lease lasts; see `hold_lease`.
    """

    def __init__(self, fish: Fish, calibration: ServoCalibration) -> None:
        self.calibration = calibration
        """Calibration that fishd uses now."""
        self.angle = 0.0
        """Present angle of the tail [rad]."""
        self.amplitude = fish.status().amplitude_limit
        """Amplitude limit Φ [rad]."""
        self._fish = fish

    def begin_trial(self) -> None:
        """Begin the trial: only the controller `hold` can become active from now on."""
        self._apply(self.calibration)

    def adjust(self, **changes: Any) -> None:
        """Let fishd use a changed calibration without saving it; print its refusal, if any."""
        try:
            self._apply(replace(self.calibration, **changes))
        except Refused as refusal:
            if refusal.code != "bad-arguments":
                raise
            echo(f"  no: {refusal}")

    def move_to(self, angle: float) -> bool:
        """Move slowly to an angle [rad]; return False if the tail stops before it."""
        angle = max(-self.amplitude, min(self.amplitude, angle))
        while abs(angle - self.angle) > _ANGLE_TOLERANCE_RAD:
            step = max(-MAX_MOVE_RAD, min(MAX_MOVE_RAD, angle - self.angle))
            target = round(self.angle + step, 9)
            state = self._fish.set_controller("hold", angle=target)
            self.angle = self._await_angle(target, state.seq)
            if abs(self.angle - target) > _ANGLE_TOLERANCE_RAD:
                return False
            time.sleep(MOVE_INTERVAL_S)
        return True

    @property
    def reach(self) -> tuple[float, float]:
        """Lowest and highest angle that Φ, limits and pulses permit now [rad]."""
        status = self._fish.status()
        return status.lowest_angle, status.highest_angle

    def go_to_neutral(self) -> None:
        """Fade to neutral, and wait until the tail is there."""
        state = self._fish.stop()
        self.angle = self._await_angle(0.0, state.seq)

    def _apply(self, calibration: ServoCalibration) -> None:
        """Let fishd use a calibration; raise `click.ClickException` while fishd is in fault."""
        status = self._fish.status()
        if status.reason:
            raise click.ClickException(
                f"fishd is in {status.mode}: {status.reason.message}; mend the cause, then clear "
                "it with 'fishctl clear-fault'"
            )
        self._fish.calibrate_servo(calibration, save=False)
        self.calibration = calibration

    def _await_angle(self, target: float, first: int) -> float:
        """Wait until the instruction angle is `target`, or stops elsewhere; return the angle [rad].

        first: number of the first tick under the new target; telemetry may lag behind replies, and
            in earlier ticks the tail still rests at its previous angle
        """
        angle = math.nan
        for tick in self._fish.ticks():
            if tick.seq < first:
                continue
            previous, angle = angle, tick.phi_c
            if abs(angle - target) < _ANGLE_TOLERANCE_RAD or angle == previous:
                break
        return angle


@click.command()
@endpoint_option
@take_option
def servo(endpoint: str | None) -> None:
    """Find the servo's trim, direction and limits by small steps.

    Watch the tail. A positive angle moves it to the fish's left. The fish must be at
    rest. Nothing is saved before you say yes; on Ctrl-C or any error the previous calibration is
    in use again.
    """
    with Fish(endpoint) as fish, input_interrupted():
        previous = fish.calibrations().servo
        tail = Tail(fish, previous)
        with hold_lease(fish, previous, tail.begin_trial) as lease:
            echo("Keep hands and cables clear of the tail. Ctrl-C stops it at any prompt.")
            _find_trim(tail)
            _find_direction(tail)
            _find_limit(tail, +1)
            _find_limit(tail, -1)
            _print_changes(previous, tail.calibration)
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
    tail.go_to_neutral()
    while True:
        word = choose(f"trim {tail.calibration.trim:+g} µs", *STEPS, "ok", suffix="> ")
        if word == "ok":
            return
        tail.adjust(trim=tail.calibration.trim + TRIM_STEP * STEPS[word])


def _find_direction(tail: Tail) -> None:
    echo(f"\nDirection: the tail moves by {TEST_ANGLE:g} rad, slowly, and stays there.")
    answer = "a"
    while answer != "y":
        tail.move_to(TEST_ANGLE)
        question = "Did it move to the fish's left? y, n, or a for again"
        answer = choose(question, "y", "n", "a")
        tail.go_to_neutral()
        if answer == "n":
            old = tail.calibration
            # The mechanical stops stay in place, which is now on the other side of neutral.
            tail.adjust(
                direction=-old.direction,
                lowest=0.0 - old.highest,
                highest=0.0 - old.lowest,
            )
            echo("The direction is reversed. The test is repeated.")


def _find_limit(tail: Tail, side: int) -> None:
    """Find the limit to the fish's left (1) or right (-1)."""
    key, name = ("highest", "left") if side > 0 else ("lowest", "right")
    old = getattr(tail.calibration, key)
    echo(
        f"\nLimit to the fish's {name}: + goes {LIMIT_STEP:g} rad further and - back, ++ and -- "
        f"{5 * LIMIT_STEP:g} rad; ok where it may go no further, keep for {old:+g} rad as it was."
    )
    tail.adjust(**{key: side * NO_LIMIT})
    reach = abs(tail.reach[side > 0])
    limit = old
    while True:
        word = choose(f"{key} {tail.angle:+.2f} rad", *STEPS, "ok", "keep", suffix="> ")
        if word in STEPS:
            target = max(0.0, side * tail.angle + LIMIT_STEP * STEPS[word])
            if not tail.move_to(side * target):
                echo("  no further: the pulses of a servo end here")
            elif target > tail.amplitude:
                echo("  no further: this is amplitude_limit")
        elif word == "ok" and tail.angle == 0.0:
            echo("  the tail could not go this way at all; go to its limit first, or keep")
        elif word == "ok" and side * tail.angle >= tail.amplitude and side * old > tail.amplitude:
            # No stop was reached: keep a limit that lies beyond.
            echo(f"  free as far as amplitude_limit; {key} stays at {old:+g} rad")
            break
        else:
            limit = round(tail.angle, 4) if word == "ok" else old
            break
    if reach < tail.amplitude and abs(limit) > reach:
        limit = side * math.floor(reach * 1e4) / 1e4
        echo(f"  {key} is {limit:+g} rad now, where the pulses of a servo end")
    tail.go_to_neutral()
    tail.adjust(**{key: limit})


def _print_changes(previous: ServoCalibration, now: ServoCalibration) -> None:
    units = {"trim": "µs", "direction": "±1", "scale": "µs/rad", "lowest": "rad", "highest": "rad"}
    echo(f"\n{'':<16}{'before':>10}{'now':>10}")
    for name, unit in units.items():
        old, new = getattr(previous, name), getattr(now, name)
        echo(f"{f'{name} [{unit}]':<16}{old:>+10g}{new:>+10g}")


@contextlib.contextmanager
def hold_lease(
    fish: Fish, before: ServoCalibration, begin: Callable[[], object]
) -> Iterator[LeaseRenewal]:
    """Hold the lease of the fish; after an error or a signal, end it and print the state.

    A lost lease raises `LeaseLost`, at a prompt too: set `when_lost` to a function that does
    nothing before the calibration is saved. For the main thread, which alone can be interrupted.
    begin: begins the trial of a calibration, or raises an error
    """
    with fish.lease(*verb_lease(), idle_limit=None) as lease:
        begin()

        def interrupt(number: int, _: Any) -> None:
            if number != signal.SIGUSR1:
                raise KeyboardInterrupt
            if lease.lost:
                raise lease.lost

        # A lost terminal (ssh) must not leave the tail deflected.
        numbers = (signal.SIGINT, signal.SIGHUP, signal.SIGTERM, signal.SIGUSR1)
        handlers = {number: signal.signal(number, interrupt) for number in numbers}
        main = threading.get_ident()
        lease.when_lost = lambda: signal.pthread_kill(main, signal.SIGUSR1)  # ends a prompt, too
        try:
            yield lease
        except BaseException:
            for number in numbers:
                signal.signal(number, signal.SIG_IGN)
            lease.stop()
            lease.returned = True
            outcome = _end_lease(fish.endpoint, lease.token, before)
            with contextlib.suppress(OSError):  # the terminal may be lost
                echo(f"\n{outcome}", err=True)
            raise
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)


def _end_lease(endpoint: str, lease: str, before: ServoCalibration) -> str:
    """End a lease, wait until `before` is used again; return the state then, in one line.

    It opens a new connection, without an unfinished request on it.
    """
    try:
        with Fish(endpoint) as fish:
            with contextlib.suppress(Refused):  # it has ended already
                fish.end_lease(lease)
            calibrations, status = _await_end_of_trial(fish)
    except FishError as error:
        return (
            f"the position of the servo is unknown: {error}; a fishd that still runs returns to "
            "the previous calibration by itself, within seconds"
        )
    return f"{_describe_servo(status)}; {_describe_calibration(calibrations, before)}"


def _await_end_of_trial(fish: Fish) -> tuple[Calibrations, Status]:
    """Wait until the trial has ended and, in fault, the pulses, too."""
    start = time.monotonic()
    while True:
        report, status = fish.calibrations(), fish.status()
        done = not report.on_trial and not (status.mode == "fault" and status.servo_on)
        is_estop = status.mode == "estop"  # the tail may stay in place, and the lease with it
        if done or time.monotonic() - start > (
            _ESTOP_TIMEOUT_S if is_estop else _NEUTRAL_TIMEOUT_S
        ):
            return report, status
        time.sleep(_POLL_INTERVAL_S)


def _describe_servo(status: Status) -> str:
    if status.reason:
        pulses = "cannot be released and may have pulses" if status.servo_on else "is released"
        return f"fishd is in {status.mode}, the servo {pulses}"
    if status.mode == "running":
        return f"{status.controller} is the active controller"
    return "the servo is at neutral"


def _describe_calibration(calibrations: Calibrations, before: ServoCalibration) -> str:
    if calibrations.on_trial:
        return "its calibration will be that of before as soon as the tail is at neutral"
    if calibrations.servo == before:
        return "its calibration is as before"
    return f"its calibration is another one: {calibrations.servo_file or 'on trial'}"
