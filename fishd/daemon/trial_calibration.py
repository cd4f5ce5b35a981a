"""Which calibration of the servo applies: the saved one, or a trial calibration for a lease.

A lease ends by itself when whoever has it no longer renews it.
"""

import asyncio
import secrets

from fishd.config.consistency import check_neutral, check_pulses
from fishd.control.loop import ControlLoop
from fishd.control.supervisor import Mode
from fishd.core.calibration import ServoCalibration
from fishd.core.clock import Clock
from fishd.core.errors import Refused
from fishd.core.protocol import LEASE
from fishd.core.schema import Problem
from fishd.hardware.base import CalibratedParts, TaredSensor
from fishd.hardware.servo import pulses
from fishd.hardware.settings import ServoSettings

_WATCH = 0.1
"""Time between two looks at a lease [s]."""


def calibrated_parts(loop: ControlLoop) -> CalibratedParts:
    """What can be calibrated; raises `Refused` for a simulated fish."""
    parts = loop.robot.calibrated
    if parts is None:
        raise Refused(
            "simulated", "a simulated fish has nothing to calibrate; see robot: virtual-pi"
        )
    return parts


def calibrated_parts_at_rest(loop: ControlLoop) -> CalibratedParts:
    """The same while nothing swims; `hold` may be active. Raises `Refused`."""
    parts = calibrated_parts(loop)
    _check_rest(loop)
    return parts


def tared_sensor_at_rest(loop: ControlLoop) -> TaredSensor:
    """The force sensor, a simulated one too, while nothing swims; raises `Refused`."""
    if loop.robot.tared is None:
        raise Refused("simulated", "this fish's force sensor has no zero to set")
    _check_rest(loop)
    return loop.robot.tared


def _check_rest(loop: ControlLoop) -> None:
    if loop.supervisor.mode is Mode.RUNNING and loop.active.name != "hold":
        raise Refused(
            "running", f"{loop.active.name} is the active controller; stop it with 'fishctl stop'"
        )


class _Lease:
    """A trial calibration: its holder, its end, and the previous calibration."""

    def __init__(self, before: ServoCalibration, now: float) -> None:
        self.identity = secrets.token_hex(8)  # that of a daemon before this one is another
        self.before = before
        self.until = now + LEASE
        self.ending = ""
        """Why it ends, once it does."""


class TrialCalibration:
    """Applies calibrations of the servo, and takes a lease back."""

    def __init__(
        self, loop: ControlLoop, clock: Clock, settings: ServoSettings, changing: asyncio.Lock
    ) -> None:
        """changing: held by whoever replaces a calibration"""
        self._loop = loop
        self._now = clock.monotonic
        self._settings = settings
        self._changing = changing
        self._lease: _Lease | None = None
        self._watcher: asyncio.Task[None] | None = None

    @property
    def lease(self) -> str | None:
        """The identity of the lease that lasts; None without one."""
        return self._lease.identity if self._lease else None

    def check_startable(self, controller: str) -> None:
        """Raises `Refused` for all but `hold` while a lease lasts, and for any while it ends."""
        lease = self._lease
        if lease and (controller != "hold" or lease.ending):
            raise Refused(
                "calibrating",
                f"the servo is being calibrated, {controller} cannot take over; wait for its end, "
                f"or for {LEASE:g} s after it was given up",
            )

    def check(self, calibration: ServoCalibration, lease: str | None, *, keep: bool) -> None:
        """Raises `Refused` unless whoever has this lease may apply that just now.

        keep: to save it, so that its pulses must do what a configuration's must
        """
        parts = calibrated_parts_at_rest(self._loop)
        if lease is not None:
            self._mine(lease)
        elif self._lease:
            raise Refused(
                "calibrating",
                "the servo is being calibrated by another client; wait for its end, or for "
                f"{LEASE:g} s after it was given up",
            )
        servo = self._settings.calibrated(calibration)
        try:
            check_neutral(servo)
            if keep:
                check_pulses(servo, self._loop.limits.amplitude)
        except Problem as problem:
            raise Refused("bad-arguments", f"{problem.path[-1]}: {problem}") from None
        lowest, highest = pulses.reach(servo)
        present, angle = parts.servo.calibration, self._loop.applied
        same = (calibration.direction, calibration.scale) == (present.direction, present.scale)
        if not (lowest <= angle <= highest and (same or angle == 0.0)):
            raise Refused(
                "not-neutral",
                f"the tail is at {angle:+.3f} rad and would jump; bring it to neutral with "
                "'fishctl stop'",
            )

    def try_out(self, calibration: ServoCalibration) -> None:
        """Apply a calibration that `check` lets pass; begins a lease, or renews it."""
        if self._lease is None:
            self._lease = _Lease(
                calibrated_parts_at_rest(self._loop).servo.calibration, self._now()
            )
            self._watcher = asyncio.create_task(self._watch(self._lease))
        self._lease.until = self._now() + LEASE
        self._put(calibration)

    def keep(self, calibration: ServoCalibration) -> None:
        """Apply a calibration that `check` lets pass, without a lease from now on."""
        self._lease = None
        self._put(calibration)

    def renew(self, lease: str) -> None:
        """Let a lease last for another `LEASE` seconds; raises `Refused` where it has ended."""
        self._mine(lease).until = self._now() + LEASE

    def end(self, lease: str) -> None:
        """Begin to end a lease: neutral, then the previous calibration. Raises `Refused`."""
        self._end(self._mine(lease), "given back")

    def _mine(self, identity: str) -> _Lease:
        lease = self._lease
        if lease is None or lease.identity != identity or lease.ending:
            raise Refused(
                "no-lease",
                f"this lease has ended: it was given back, or not renewed for {LEASE:g} s, or "
                "fishd was restarted; the previous calibration is used again",
            )
        return lease

    def _end(self, lease: _Lease, why: str) -> None:
        lease.ending = why
        self._loop.stop()

    async def _watch(self, lease: _Lease) -> None:
        """Until a lease is over: end it when its time is up, and put back what was before."""
        while True:
            await asyncio.sleep(_WATCH)
            async with self._changing:  # it must not end while what it led to is being saved
                if self._lease is not lease:
                    return
                if not lease.ending and self._now() > lease.until:
                    self._end(lease, f"not renewed for {LEASE:g} s")
                if lease.ending and self._at_rest(lease.before):
                    self._lease = None
                    self._put(lease.before)
                    self._loop.reporter.event(
                        "calibration",
                        f"servo: that of before is used again, the lease was {lease.ending}",
                        "info" if lease.ending == "given back" else "warning",
                    )
                    return

    def _at_rest(self, before: ServoCalibration) -> bool:
        """Is the tail where no calibration moves it, or free to move and within the limits?"""
        lowest, highest = pulses.reach(self._settings.calibrated(before))
        angle = self._loop.applied
        return angle == 0.0 or (not self._loop.servo.on and lowest <= angle <= highest)

    def _put(self, calibration: ServoCalibration) -> None:
        parts = calibrated_parts(self._loop)
        if parts.servo.calibration.direction != calibration.direction:
            self._loop.lateral_sign.forget()
        parts.servo.recalibrate(calibration)
        parts.recalibrated(calibration)
        self._loop.guard.restrict(*parts.servo.reach)
