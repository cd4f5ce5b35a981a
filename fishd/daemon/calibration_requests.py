"""Requests about calibrations: measure, tare, and apply another calibration."""

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
    LOADING_TIMEOUT_S,
    MAX_SAMPLE_AGE_S,
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

MAX_CONCURRENT_SAMPLES = 4
"""Largest number of force samples taken at once; each adds work to every read of the sensor."""
_CHECK_PERIOD_S = 0.05
"""Time between two checks whether a controller has been started [s]."""
_FORCE_CHECK_S = 0.2
"""Time for which the present force is measured before another calibration is applied [s]."""

Handlers = dict[str, Callable[[Any], Awaitable[Any]]]
"""Handlers of requests by name of the operation; `protocol.OPERATIONS` lists the arguments."""


class CalibrationRequests:
    """Handler of the requests about calibrations; a simulated fish can only be tared."""

    def __init__(self, loop: ControlLoop, clock: Clock, config: Config, folder: Path) -> None:
        """folder: folder of the calibration files"""
        self._loop = loop
        self._clock = clock
        self._folder = CalibrationFolder(folder)
        self._sensor = config.force_sensor
        self._changing = asyncio.Lock()
        """Lock held while a calibration is replaced: the newest file must be the one in use."""
        self._servo = TrialCalibration(loop, config.servo, self._changing)
        self._samples: dict[int, tuple[float, ForceSample]] = {}
        """Time and content of each fresh sample, by number."""
        self._sampled = 0
        self._sampling = 0
        self._calls = BackgroundCalls(LOADING_TIMEOUT_S)
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
        """Function that raises `Refused` while a controller must not take over, under a lease."""

    @property
    def calibrating(self) -> bool:
        """True while a client tries a calibration of the servo."""
        return self._servo.active

    async def _calibrations(self, _: NoArguments) -> Calibrations:
        calibrated_parts(self._loop)
        return self._current_calibrations()

    def _current_calibrations(self) -> Calibrations:
        robot = self._loop.robot
        return Calibrations(
            force=robot.tared.calibration if robot.tared else ForceCalibration(),
            force_file=self._force_file,
            servo=robot.calibrated.servo.calibration if robot.calibrated else ServoCalibration(),
            servo_file=self._servo_file,
            on_trial=self._servo.active,
            force_limit=self._sensor.force_limit,
        )

    async def _sample_force(self, request: SampleForce) -> ForceSample:
        sensor = tared_sensor_at_rest(self._loop)
        if self._sampling >= MAX_CONCURRENT_SAMPLES:
            raise Refused("busy", f"{self._sampling} samples are being taken; try again")
        watch = sensor.watch()
        self._sampling += 1
        try:
            await self._rest_for(request.seconds)
        finally:
            self._sampling -= 1
            sample = watch.close()
        if sample.pairs == 0:
            raise Refused(
                "no-samples", f"the force sensor delivered no sample for {request.seconds:g} s"
            )
        self._forget_old_samples()
        self._sampled += 1
        sample = msgspec.structs.replace(sample, number=self._sampled)
        self._samples[sample.number] = (self._clock.monotonic(), sample)
        return sample

    async def _rest_for(self, seconds: float) -> None:
        """Wait; raise `Refused` as soon as a controller is active."""
        now = asyncio.get_running_loop().time
        end = now() + seconds
        while (remaining := end - now()) > 0.0:
            await asyncio.sleep(min(remaining, _CHECK_PERIOD_S))
            tared_sensor_at_rest(self._loop)

    def _forget_old_samples(self) -> None:
        oldest = self._clock.monotonic() - MAX_SAMPLE_AGE_S
        self._samples = {n: sample for n, sample in self._samples.items() if sample[0] >= oldest}

    async def _tare(self, request: Tare) -> Calibrations:
        # The sample exists already: a client that gives up while measuring changes nothing.
        self._loop.lease.check_free(request.lease)
        self._forget_old_samples()
        if request.sample not in self._samples:
            raise Refused(
                "no-samples",
                f"sample {request.sample} does not exist or is older than {MAX_SAMPLE_AGE_S:g} s; "
                "take another one with sample-force",
            )
        _, sample = self._samples[request.sample]
        if sample.suspect:
            raise Refused("suspect", f"the forces cannot be trusted: {sample.suspect}")
        async with self._changing:
            before = tared_sensor_at_rest(self._loop).calibration
            noise = max(
                math.hypot(before.xx * sample.vx_std, before.xy * sample.vy_std),
                math.hypot(before.yx * sample.vx_std, before.yy * sample.vy_std),
            )
            if noise > self._sensor.still:
                raise Refused(
                    "not-still",
                    f"the force varies by {noise * 1e3:.1f} mN rms, more than the "
                    f"{self._sensor.still * 1e3:g} mN of force_sensor.still; wait until the water "
                    "and the fish are still",
                )
            # Use the voltages: another tare may have changed the calibration since.
            fx, fy = before.forces(sample.vx, sample.vy)
            if max(abs(fx), abs(fy)) > self._sensor.tare_limit:
                raise Refused(
                    "too-large",
                    f"({fx:.3f}, {fy:.3f}) N is more than force_sensor.tare_limit, "
                    f"{self._sensor.tare_limit:g} N; something pushes the fish, or the sensor "
                    "needs 'fishctl calibrate force'",
                )
            date = self._now().isoformat(timespec="seconds")
            return await self._adopt_force(
                msgspec.structs.replace(
                    before, x0=before.x0 - fx, y0=before.y0 - fy, tare_date=date
                )
            )

    async def _calibrate_force(self, request: CalibrateForce) -> Calibrations:
        calibration = _check_calibration(request.calibration)
        self._loop.lease.check_free(request.lease)
        async with self._changing:
            await self._check_present_force(calibration)
            return await self._adopt_force(calibration)

    async def _check_present_force(self, calibration: ForceCalibration) -> None:
        """Raise `Refused` if the calibration would turn the present voltages into a fault."""
        watch = calibrated_parts_at_rest(self._loop).sensor.watch()
        try:
            await asyncio.sleep(_FORCE_CHECK_S)
        finally:
            sample = watch.close()
        fx, fy = calibration.forces(sample.vx, sample.vy)
        limit = self._sensor.force_limit
        if sample.pairs and max(abs(fx), abs(fy)) > limit:
            raise Refused(
                "too-large",
                f"({fx:.4g}, {fy:.4g}) N would be the present force, beyond "
                f"force_sensor.force_limit, {limit:g} N; were the loads in another unit, such as "
                "grams? If not, remove what pulls at the fish",
            )

    async def _adopt_force(self, calibration: ForceCalibration) -> Calibrations:
        sensor = tared_sensor_at_rest(self._loop)
        before = sensor.calibration
        if self._loop.robot.calibrated:
            calibration, path = await self._save(calibration)
            self._force_file = str(path)
            self._announce("force sensor", path)
        # Apply it in any case, since the next start will use the newest file.
        sensor.recalibrate(calibration)
        self._loop.perception.forget_force(scale=_matrix(before) != _matrix(calibration))
        return self._current_calibrations()

    async def _calibrate_servo(self, request: CalibrateServo) -> Calibrations:
        async with self._changing:
            calibration = _check_calibration(request.calibration)
            self._servo.check(calibration, request.lease, save=request.save)
            if request.save:
                calibration, path = await self._save(calibration)
                try:
                    self._servo.check(calibration, request.lease, save=True)
                except Refused:  # the lease has ended, or the fish has started to swim
                    with suppress(OSError):
                        path.unlink()  # the next start must not use it
                    raise
                self._servo.apply_saved(calibration)
                self._servo_file = str(path)
                self._announce("servo", path)
            else:
                assert request.lease
                self._servo.try_out(calibration, request.lease)
            return self._current_calibrations()

    async def _save(self, calibration: C) -> tuple[C, Path]:
        try:
            return await self._calls.call(
                "the calibration has not been written",
                partial(self._folder.save, calibration, self._now()),
                late=lambda saved: saved[1].unlink(),  # the next start must not use it
            )
        except ConfigError as error:
            raise Refused("not-saved", str(error)) from None
        except OSError as error:
            raise Refused(
                "not-saved", f"{self._folder.folder}: cannot be written: {error.strerror}"
            ) from None

    def _file(self, kind: type[C]) -> str | None:
        newest = self._folder.newest(kind) if self._loop.robot.calibrated else None
        return str(newest[1]) if newest else None

    def _now(self) -> datetime.datetime:
        return datetime.datetime.fromtimestamp(self._clock.wall()).astimezone()

    def _announce(self, what: str, path: Path) -> None:
        self._loop.reporter.event("calibration", f"{what}: {path}", file=str(path))


def _matrix(calibration: ForceCalibration) -> tuple[float, ...]:
    return calibration.xx, calibration.xy, calibration.yx, calibration.yy


def _check_calibration(calibration: C) -> C:
    """Return the same calibration; raise `Refused` if it is not valid."""
    try:
        return check(calibration)
    except Problem as problem:
        raise Refused("bad-arguments", problem.message_with_place({})) from None
