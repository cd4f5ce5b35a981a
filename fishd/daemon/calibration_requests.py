"""What can be asked about calibrations: measure, tare, and apply another one."""

import asyncio
import datetime
import math
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from fishd.config import Config
from fishd.control.loop import ControlLoop
from fishd.core.calibration import C, ForceCalibration, ForceSample, ServoCalibration
from fishd.core.clock import Clock
from fishd.core.errors import ConfigError, Refused
from fishd.core.protocol import (
    FRESH,
    LOADING,
    CalibrateForce,
    CalibrateServo,
    Calibrations,
    NoArguments,
    SampleForce,
    Tare,
)
from fishd.core.schema import Problem
from fishd.daemon.background_calls import BackgroundCalls
from fishd.daemon.trial_calibration import (
    TrialCalibration,
    calibrated_parts,
    calibrated_parts_at_rest,
    tared_sensor_at_rest,
)
from fishd.hardware.calibration_files import CalibrationFolder, check

MOST_SAMPLES = 4
"""Samples of the force that may be taken at once: each adds to every read of the sensor."""
_LOOK = 0.05
"""Time between two looks at whether a controller has been started meanwhile [s]."""
_GLANCE = 0.2
"""How long the present force is looked at before another calibration is applied [s]."""

Handlers = dict[str, Callable[[Any], Awaitable[Any]]]
"""What answers, by the name of an operation; `protocol.OPERATIONS` says what its arguments are."""


class CalibrationRequests:
    """Answers the requests about calibrations; a simulated fish can only be tared."""

    def __init__(self, loop: ControlLoop, clock: Clock, config: Config, folder: Path) -> None:
        """folder: where calibrations are kept"""
        self._loop = loop
        self._clock = clock
        self._folder = CalibrationFolder(folder)
        self._sensor = config.force_sensor
        self._changing = asyncio.Lock()
        """Held while a calibration is replaced: the newest file must be the one that is used."""
        self._servo = TrialCalibration(loop, config.servo, self._changing)
        self._samples: dict[int, tuple[float, ForceSample]] = {}
        """When each fresh sample was taken, and what it says, by its number."""
        self._sampled = 0
        self._sampling = 0
        self._calls = BackgroundCalls(LOADING)
        self._force_file = self._file(ForceCalibration)
        self._servo_file = self._file(ServoCalibration)
        self.handlers: Handlers = {
            "calibrations": self._calibrations,
            "sample-force": self._sample_force,
            "tare": self._tare,
            "calibrate-force": self._calibrate_force,
            "calibrate-servo": self._calibrate_servo,
        }
        self.check_startable = self._servo.check_startable
        """Raises `Refused` while a controller of that name must not take over, under a lease."""

    @property
    def calibrating(self) -> bool:
        """True while a client tries a calibration of the servo."""
        return self._servo.active

    async def _calibrations(self, _: NoArguments) -> Calibrations:
        calibrated_parts(self._loop)
        return self._used()

    def _used(self) -> Calibrations:
        robot = self._loop.robot
        return Calibrations(
            force=robot.tared.calibration if robot.tared else ForceCalibration(),
            force_file=self._force_file,
            servo=robot.calibrated.servo.calibration if robot.calibrated else ServoCalibration(),
            servo_file=self._servo_file,
            on_trial=self._servo.active,
            force_limit=self._sensor.force_limit,
        )

    async def _sample_force(self, wanted: SampleForce) -> ForceSample:
        sensor = tared_sensor_at_rest(self._loop)
        if self._sampling >= MOST_SAMPLES:
            raise Refused("busy", f"{self._sampling} samples are being taken; try again")
        watch = sensor.watch()
        self._sampling += 1
        try:
            await self._rest_for(wanted.seconds)
        finally:
            self._sampling -= 1
            sample = watch.close()
        if sample.pairs == 0:
            raise Refused("no-samples", f"the force sensor gave nothing for {wanted.seconds:g} s")
        self._forget_old_samples()
        self._sampled += 1
        sample = msgspec.structs.replace(sample, number=self._sampled)
        self._samples[sample.number] = (self._clock.monotonic(), sample)
        return sample

    async def _rest_for(self, seconds: float) -> None:
        """Wait; raises `Refused` as soon as a controller is active."""
        now = asyncio.get_running_loop().time
        until = now() + seconds
        while (left := until - now()) > 0.0:
            await asyncio.sleep(min(left, _LOOK))
            tared_sensor_at_rest(self._loop)

    def _forget_old_samples(self) -> None:
        oldest = self._clock.monotonic() - FRESH
        self._samples = {n: taken for n, taken in self._samples.items() if taken[0] >= oldest}

    async def _tare(self, wanted: Tare) -> Calibrations:
        # Of a sample that is there already: who gives up while measuring changes nothing.
        self._loop.lease.check_free(wanted.lease)
        self._forget_old_samples()
        if wanted.sample not in self._samples:
            raise Refused(
                "no-samples",
                f"there is no sample {wanted.sample} of the last {FRESH:g} s; take another with "
                "sample-force",
            )
        _, sample = self._samples[wanted.sample]
        if sample.suspect:
            raise Refused("suspect", f"the forces are not to be believed: {sample.suspect}")
        async with self._changing:
            before = tared_sensor_at_rest(self._loop).calibration
            restless = max(
                math.hypot(before.xx * sample.vx_std, before.xy * sample.vy_std),
                math.hypot(before.yx * sample.vx_std, before.yy * sample.vy_std),
            )
            if restless > self._sensor.still:
                raise Refused(
                    "not-still",
                    f"the force varies by {restless * 1e3:.1f} mN rms, more than the "
                    f"{self._sensor.still * 1e3:g} mN of force_sensor.still; wait until the water "
                    "and the fish are still",
                )
            # From voltages: another tare since may have changed what they mean.
            fx, fy = before.forces(sample.vx, sample.vy)
            if max(abs(fx), abs(fy)) > self._sensor.tare_limit:
                raise Refused(
                    "too-large",
                    f"({fx:.3f}, {fy:.3f}) N is more than force_sensor.tare_limit, "
                    f"{self._sensor.tare_limit:g} N; something pushes the fish, or the sensor "
                    "needs 'fishctl calibrate force'",
                )
            date = self._date().isoformat(timespec="seconds")
            return await self._adopt_force(
                msgspec.structs.replace(before, x0=before.x0 - fx, y0=before.y0 - fy, tared=date)
            )

    async def _calibrate_force(self, wanted: CalibrateForce) -> Calibrations:
        calibration = _sensible(wanted.calibration)
        self._loop.lease.check_free(wanted.lease)
        async with self._changing:
            await self._check_present_force(calibration)
            return await self._adopt_force(calibration)

    async def _check_present_force(self, calibration: ForceCalibration) -> None:
        """Of what the sensor says now, the calibration must not make a fault in the next ticks."""
        watch = calibrated_parts_at_rest(self._loop).sensor.watch()
        try:
            await asyncio.sleep(_GLANCE)
        finally:
            sample = watch.close()
        fx, fy = calibration.forces(sample.vx, sample.vy)
        limit = self._sensor.force_limit
        if sample.pairs and max(abs(fx), abs(fy)) > limit:
            raise Refused(
                "too-large",
                f"({fx:.4g}, {fy:.4g}) N would be the present force, beyond "
                f"force_sensor.force_limit, {limit:g} N; were the loads in another unit, such as "
                "grams? Else take off what pulls at the fish",
            )

    async def _adopt_force(self, calibration: ForceCalibration) -> Calibrations:
        sensor = tared_sensor_at_rest(self._loop)
        before = sensor.calibration
        if self._loop.robot.calibrated:
            calibration, path = await self._save(calibration)
            self._force_file = str(path)
            self._announce("force sensor", path)
        # The newest file is used from the next start on, so it is now, whatever else began.
        sensor.recalibrate(calibration)
        self._loop.forget_force(scale=_matrix(before) != _matrix(calibration))
        return self._used()

    async def _calibrate_servo(self, wanted: CalibrateServo) -> Calibrations:
        async with self._changing:
            calibration = _sensible(wanted.calibration)
            self._servo.check(calibration, wanted.lease, keep=wanted.save)
            if wanted.save:
                calibration, path = await self._save(calibration)
                try:
                    self._servo.check(calibration, wanted.lease, keep=True)
                except Refused:  # the lease has ended meanwhile, or the fish swims
                    with suppress(OSError):
                        path.unlink()  # not to be used from the next start on
                    raise
                self._servo.keep(calibration)
                self._servo_file = str(path)
                self._announce("servo", path)
            else:
                assert wanted.lease
                self._servo.try_out(calibration, wanted.lease)
            return self._used()

    async def _save(self, calibration: C) -> tuple[C, Path]:
        try:
            return await self._calls.call(
                "the calibration has not been written",
                partial(self._folder.save, calibration, self._date()),
                late=lambda saved: saved[1].unlink(),  # not to be used from the next start on
                interrupt=False,  # between the file's coming into being and its name in the result
            )
        except ConfigError as error:
            raise Refused("not-saved", str(error)) from None
        except OSError as error:
            raise Refused(
                "not-saved", f"{self._folder.folder}: cannot be written: {error.strerror}"
            ) from None

    def _file(self, kind: type[C]) -> str | None:
        found = self._folder.newest(kind) if self._loop.robot.calibrated else None
        return str(found[1]) if found else None

    def _date(self) -> datetime.datetime:
        return datetime.datetime.fromtimestamp(self._clock.wall()).astimezone()

    def _announce(self, what: str, path: Path) -> None:
        self._loop.reporter.event("calibration", f"{what}: {path}", file=str(path))


def _matrix(calibration: ForceCalibration) -> tuple[float, ...]:
    return calibration.xx, calibration.xy, calibration.yx, calibration.yy


def _sensible(calibration: C) -> C:
    """The same calibration; raises `Refused` where it is one that a file could not hold."""
    try:
        return check(calibration)
    except Problem as problem:
        raise Refused("bad-arguments", problem.located({})) from None
