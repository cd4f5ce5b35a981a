"""Calibration of the servo that applies: the saved one, or one on trial under a lease.

When the lease ends, for any reason, the previous calibration is used again.
"""

import asyncio

from fishd.config.consistency import check_neutral, check_pulses
from fishd.control.lease import RETURN_REASON
from fishd.control.loop import ControlLoop
from fishd.control.supervisor import Mode
from fishd.core.calibration import ServoCalibration
from fishd.core.errors import Refused
from fishd.core.schema import Problem
from fishd.hardware.base import CalibratedParts, TaredSensor
from fishd.hardware.servo import pulses
from fishd.hardware.settings import ServoSettings

_LEASE_CHECK_PERIOD_S = 0.1
"""Time between two checks of a lease [s]."""


def calibrated_parts(loop: ControlLoop) -> CalibratedParts:
    """Return the parts that can be calibrated; raise `Refused` for a simulated fish."""
    parts = loop.robot.calibrated
    if parts is None:
        raise Refused(
            "simulated", "a simulated fish has nothing to calibrate; see robot: virtual-pi"
        )
    return parts


def calibrated_parts_at_rest(loop: ControlLoop) -> CalibratedParts:
    """Do as `calibrated_parts`; also raise `Refused` while a controller except `hold` is active."""
    parts = calibrated_parts(loop)
    _check_rest(loop)
    return parts


def tared_sensor_at_rest(loop: ControlLoop) -> TaredSensor:
    """Return the force sensor, real or simulated; raise `Refused` while the fish swims."""
    if loop.robot.tared is None:
        raise Refused("simulated", "this fish's force sensor has no zero to set")
    _check_rest(loop)
    return loop.robot.tared


def _check_rest(loop: ControlLoop) -> None:
    if loop.supervisor.mode is Mode.RUNNING and loop.active.name != "hold":
        raise Refused(
            "running", f"{loop.active.name} is the active controller; stop it with 'fishctl stop'"
        )


class _Trial:
    """Trial of a calibration: the lease that it needs, and the previous calibration."""

    def __init__(self, lease: str, before: ServoCalibration) -> None:
        self.lease = lease
        self.before = before


class TrialCalibration:
    """Calibrations of the servo: applied or on trial; a trial is undone when its lease ends."""

    def __init__(self, loop: ControlLoop, settings: ServoSettings, changing: asyncio.Lock) -> None:
        """changing: lock that is held while a calibration is replaced"""
        self._loop = loop
        self._settings = settings
        self._changing = changing
        self._trial: _Trial | None = None
        self._watcher: asyncio.Task[None] | None = None

    @property
    def active(self) -> bool:
        """True while a calibration that is not saved is in use."""
        return self._trial is not None

    def check_startable(self, controller: str, lease: str | None) -> None:
        """Raise `Refused` during a trial for every controller except `hold` under its lease."""
        trial = self._trial
        if trial and not (
            controller == "hold" and lease == trial.lease and self._why_ended(trial) is None
        ):
            raise Refused(
                "calibrating",
                f"the servo is being calibrated, {controller} cannot take over; wait for the end "
                "of the calibration, or end it with 'fishctl stop'",
            )

    def check(self, calibration: ServoCalibration, lease: str | None, *, save: bool) -> None:
        """Raise `Refused` unless a client with this lease may apply the calibration now.

        save: whether it will be saved; then its pulses must satisfy the checks of a configuration
        """
        parts = calibrated_parts_at_rest(self._loop)
        if lease is not None:
            self._loop.lease.renew(lease)
        elif not save:
            raise Refused("no-lease", "a calibration that is not saved needs a lease: take-lease")
        self._loop.lease.check_free(lease)
        if self._trial and self._trial.lease != lease:
            raise Refused("calibrating", "the trial of another calibration is ending; try again")
        servo = self._settings.calibrated(calibration)
        try:
            check_neutral(servo)
            if save:
                check_pulses(servo, self._loop.limits.amplitude)
        except Problem as problem:
            raise Refused("bad-arguments", f"{problem.path[-1]}: {problem}") from None
        lowest, highest = pulses.reach(servo)
        present, instruction_angle = parts.servo.calibration, self._loop.instruction_angle
        same = (calibration.direction, calibration.scale) == (present.direction, present.scale)
        if not (lowest <= instruction_angle <= highest and (same or instruction_angle == 0.0)):
            raise Refused(
                "not-neutral",
                f"the tail is at {instruction_angle:+.3f} rad and would jump; bring it to neutral "
                "with 'fishctl stop'",
            )

    def try_out(self, calibration: ServoCalibration, lease: str) -> None:
        """Apply a calibration that `check` accepts, until the lease ends."""
        if self._trial is None:
            self._trial = _Trial(lease, calibrated_parts_at_rest(self._loop).servo.calibration)
            self._watcher = asyncio.create_task(self._watch(self._trial))
        self._loop.lease.drives = True
        self._apply(calibration)

    def apply_saved(self, calibration: ServoCalibration) -> None:
        """Apply a calibration that `check` accepts, independently of a lease."""
        self._trial = None
        self._apply(calibration)

    def _why_ended(self, trial: _Trial) -> str | None:
        return self._loop.lease.why_ended(trial.lease)

    async def _watch(self, trial: _Trial) -> None:
        """Use the previous calibration again when the lease of a trial has ended, at neutral."""
        while True:
            await asyncio.sleep(_LEASE_CHECK_PERIOD_S)
            async with self._changing:  # a trial must not end while its calibration is being saved
                if self._trial is not trial:
                    return
                why = self._why_ended(trial)
                if why is not None:
                    self._loop.lease.forget(trial.lease)
                if why is not None and self._at_rest(trial.before):
                    self._trial = None
                    self._apply(trial.before)
                    self._loop.reporter.event(
                        "calibration",
                        f"servo: the previous calibration is used again; lease ended: {why}",
                        "info" if why == RETURN_REASON else "warning",
                    )
                    return

    def _at_rest(self, before: ServoCalibration) -> bool:
        """Return whether another calibration cannot make the tail jump.

        It cannot at angle 0, nor without pulses at an angle within the limits.
        """
        lowest, highest = pulses.reach(self._settings.calibrated(before))
        instruction_angle = self._loop.instruction_angle
        return instruction_angle == 0.0 or (
            not self._loop.servo.on and lowest <= instruction_angle <= highest
        )

    def _apply(self, calibration: ServoCalibration) -> None:
        parts = calibrated_parts(self._loop)
        if parts.servo.calibration.direction != calibration.direction:
            self._loop.perception.lateral_sign.forget()
        parts.servo.recalibrate(calibration)
        parts.recalibrated(calibration)
        self._loop.guard.restrict(*parts.servo.reach)
