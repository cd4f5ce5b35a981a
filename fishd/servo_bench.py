"""Which calibration of the servo is in force: one that is kept, or another for a loan.

A loan is for trying: it ends by itself when whoever has it no longer renews it.
"""

import asyncio
import secrets

from fishd.clock import Clock
from fishd.config_checks import check_neutral, check_pulses
from fishd.errors import Refused
from fishd.hardware import pulses
from fishd.hardware.base import Bench
from fishd.hardware.calibration import ServoCalibration, calibrated
from fishd.hardware.settings import ServoSettings
from fishd.loop import ControlLoop
from fishd.protocol import LOAN
from fishd.schema import Problem
from fishd.supervisor import Mode

_WATCH = 0.1
"""Time between two looks at a loan [s]."""


def resting_bench(loop: ControlLoop) -> Bench:
    """What can be calibrated, while nothing swims; `hold` may be in command. Raises `Refused`."""
    bench = loop.robot.bench
    if bench is None:
        raise Refused(
            "simulated", "a simulated fish has nothing to calibrate; see robot: virtual-pi"
        )
    if loop.supervisor.mode is Mode.RUNNING and loop.controller_name != "hold":
        raise Refused(
            "running", f"{loop.controller_name} is in command; stop it with 'fishctl stop'"
        )
    return bench


class _Loan:
    """Who tries which calibration for how long, and what was in force before."""

    def __init__(self, before: ServoCalibration, now: float) -> None:
        self.identity = secrets.token_hex(8)  # that of a daemon before this one is another
        self.before = before
        self.until = now + LOAN
        self.ending = ""
        """Why it ends, once it does."""


class ServoBench:
    """Puts calibrations of the servo in force, and takes a loan back."""

    def __init__(
        self, loop: ControlLoop, clock: Clock, settings: ServoSettings, changing: asyncio.Lock
    ) -> None:
        """changing: held by whoever replaces a calibration"""
        self._loop = loop
        self._now = clock.monotonic
        self._settings = settings
        self._changing = changing
        self._loan: _Loan | None = None
        self._watcher: asyncio.Task[None] | None = None

    @property
    def loan(self) -> str | None:
        """The identity of the loan that lasts; None without one."""
        return self._loan.identity if self._loan else None

    def check_startable(self, controller: str) -> None:
        """Raises `Refused` for all but `hold` while a loan lasts, and for any while it ends."""
        loan = self._loan
        if loan and (controller != "hold" or loan.ending):
            raise Refused(
                "calibrating",
                f"the servo is being calibrated, {controller} cannot take over; wait for its end, "
                f"or for {LOAN:g} s after it was given up",
            )

    def check(self, calibration: ServoCalibration, loan: str | None, *, keep: bool) -> None:
        """Raises `Refused` unless whoever has this loan may put that in force just now.

        keep: for good, so that its pulses must do what a configuration's must; a loan is for trying
        """
        bench = resting_bench(self._loop)
        if loan is not None:
            self._mine(loan)
        elif self._loan:
            raise Refused(
                "calibrating",
                "the servo is being calibrated by another client; wait for its end, or for "
                f"{LOAN:g} s after it was given up",
            )
        servo = calibrated(self._settings, calibration)
        try:
            check_neutral(servo)
            if keep:
                check_pulses(servo, self._loop.limits.amplitude)
        except Problem as problem:
            raise Refused("bad-arguments", f"{problem.path[-1]}: {problem}") from None
        lowest, highest = pulses.reach(servo)
        present, angle = bench.servo.calibration, self._loop.applied
        same = (calibration.direction, calibration.scale) == (present.direction, present.scale)
        if not (lowest <= angle <= highest and (same or angle == 0.0)):
            raise Refused(
                "not-neutral",
                f"the tail is at {angle:+.3f} rad and would jump; bring it to neutral with "
                "'fishctl stop'",
            )

    def lend(self, calibration: ServoCalibration) -> None:
        """Put a calibration that `check` lets pass in force, for a loan or for the rest of one."""
        if self._loan is None:
            self._loan = _Loan(resting_bench(self._loop).servo.calibration, self._now())
            self._watcher = asyncio.create_task(self._watch(self._loan))
        self._loan.until = self._now() + LOAN
        self._put(calibration)

    def keep(self, calibration: ServoCalibration) -> None:
        """Put a calibration that `check` lets pass in force for good; a loan is over then."""
        self._loan = None
        self._put(calibration)

    def renew(self, loan: str) -> None:
        """Let a loan last for another `LOAN` seconds; raises `Refused` where it has ended."""
        self._mine(loan).until = self._now() + LOAN

    def end(self, loan: str) -> None:
        """Begin to end a loan: neutral, then what was in force before. Raises `Refused`."""
        self._end(self._mine(loan), "given back")

    def _mine(self, identity: str) -> _Loan:
        loan = self._loan
        if loan is None or loan.identity != identity or loan.ending:
            raise Refused(
                "no-loan",
                f"this loan has ended, it was not renewed for {LOAN:g} s or fishd was restarted; "
                "what it changed is not in force any more",
            )
        return loan

    def _end(self, loan: _Loan, why: str) -> None:
        loan.ending = why
        self._loop.stop()

    async def _watch(self, loan: _Loan) -> None:
        """Until a loan is over: end it when its time is up, and put back what was before."""
        while True:
            await asyncio.sleep(_WATCH)
            async with self._changing:  # it must not end while what it led to is being saved
                if self._loan is not loan:
                    return
                if not loan.ending and self._now() > loan.until:
                    self._end(loan, f"not renewed for {LOAN:g} s")
                if loan.ending and self._at_rest(loan.before):
                    self._loan = None
                    self._put(loan.before)
                    self._loop.reporter.event(
                        "calibration",
                        f"servo: that of before is in force again, the loan was {loan.ending}",
                        "info" if loan.ending == "given back" else "warning",
                    )
                    return

    def _at_rest(self, before: ServoCalibration) -> bool:
        """Is the tail where no calibration moves it, or free to move and within the limits?"""
        lowest, highest = pulses.reach(calibrated(self._settings, before))
        angle = self._loop.applied
        return angle == 0.0 or (not self._loop.servo_on and lowest <= angle <= highest)

    def _put(self, calibration: ServoCalibration) -> None:
        bench = self._loop.robot.bench
        assert bench
        bench.servo.recalibrate(calibration)
        bench.recalibrated(calibration)
        self._loop.guard.restrict(*pulses.reach(calibrated(self._settings, calibration)))
