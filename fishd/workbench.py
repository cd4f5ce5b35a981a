"""What can be asked about calibrations: measure, tare, and put another one in force."""

import asyncio
import datetime
import math
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

from fishd.clock import Clock
from fishd.config import Config
from fishd.errors import ConfigError, Refused
from fishd.hardware import pulses
from fishd.hardware.base import Bench
from fishd.hardware.calibration import (
    C,
    CalibrationFolder,
    ForceCalibration,
    ForceSample,
    ServoCalibration,
    calibrated,
)
from fishd.loop import ControlLoop
from fishd.protocol import CalibrateForce, CalibrateServo, Calibrations, NoArguments, SampleForce
from fishd.supervisor import Mode

Operations = dict[str, tuple[type[Struct], Callable[[Any], Awaitable[Any]]]]
"""What can be asked for: the arguments, and what answers."""


class Workbench:
    """Answers the requests about calibrations of a robot; refuses them for a simulated fish."""

    def __init__(self, loop: ControlLoop, clock: Clock, config: Config, folder: Path) -> None:
        """folder: where calibrations are kept"""
        self._loop = loop
        self._clock = clock
        self._folder = CalibrationFolder(folder)
        self._sensor = config.force_sensor
        self._servo = config.servo
        self._changing = asyncio.Lock()
        """Held while a calibration is replaced: the newest file must be the one in force."""
        self._force_file = self._file(ForceCalibration)
        self._servo_file = self._file(ServoCalibration)
        self.operations: Operations = {
            "calibrations": (NoArguments, self._calibrations),
            "sample-force": (SampleForce, self._sample_force),
            "tare": (SampleForce, self._tare),
            "calibrate-force": (CalibrateForce, self._calibrate_force),
            "calibrate-servo": (CalibrateServo, self._calibrate_servo),
        }

    async def _calibrations(self, _: NoArguments) -> Calibrations:
        bench = self._bench()
        return Calibrations(
            bench.sensor.calibration, self._force_file, bench.servo.calibration, self._servo_file
        )

    async def _sample_force(self, wanted: SampleForce) -> ForceSample:
        sensor = self._resting_bench().sensor
        watch = sensor.watch()
        try:
            await asyncio.sleep(wanted.seconds)
        finally:
            sample = watch.close()
        self._resting_bench()  # a controller may have been started meanwhile
        if sample.pairs == 0:
            raise Refused("no-samples", f"the force sensor gave nothing for {wanted.seconds:g} s")
        return sample

    async def _tare(self, wanted: SampleForce) -> Calibrations:
        sample = await self._sample_force(wanted)
        if sample.suspect:
            raise Refused("suspect", f"the forces are not to be believed: {sample.suspect}")
        async with self._changing:
            before = self._resting_bench().sensor.calibration
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
        calibration = wanted.calibration
        numbers = (calibration.xx, calibration.xy, calibration.yx, calibration.yy)
        if calibration.xx * calibration.yy - calibration.xy * calibration.yx == 0.0:
            raise Refused("bad-arguments", f"the matrix {numbers} says the same of both forces")
        async with self._changing:
            return await self._adopt_force(calibration)

    async def _adopt_force(self, calibration: ForceCalibration) -> Calibrations:
        self._resting_bench()
        saved, path = await self._save(calibration)
        # The newest file is in force from the next start on, so it is now, whatever else began.
        self._bench().sensor.recalibrate(saved)
        self._force_file = str(path)
        self._announce("force sensor", path)
        return await self._calibrations(NoArguments())

    async def _calibrate_servo(self, wanted: CalibrateServo) -> Calibrations:
        async with self._changing:
            calibration = wanted.calibration
            self._check_servo(calibration)
            path = None
            if wanted.save:
                calibration, path = await self._save(calibration)
                self._check_servo(calibration)
            self._bench().servo.recalibrate(calibration)
            self._loop.guard.restrict(*pulses.reach(calibrated(self._servo, calibration)))
            if path:
                self._servo_file = str(path)
                self._announce("servo", path)
            return await self._calibrations(NoArguments())

    def _check_servo(self, calibration: ServoCalibration) -> None:
        """Raise `Refused` unless the calibration can be put in force just now."""
        present = self._resting_bench().servo.calibration
        servo = calibrated(self._servo, calibration)
        lowest, highest = pulses.reach(servo)
        if not lowest <= 0.0 <= highest:
            raise Refused(
                "bad-arguments",
                f"neutral would be a pulse of {servo.centre + servo.trim:g} µs, beyond 500 to "
                "2500 µs",
            )
        angle = self._loop.applied
        same = (calibration.direction, calibration.scale) == (present.direction, present.scale)
        if not (lowest <= angle <= highest and (same or angle == 0.0)):
            raise Refused(
                "not-neutral",
                f"the tail is at {angle:+.3f} rad and would jump; bring it to neutral with "
                "'fishctl stop'",
            )

    def _bench(self) -> Bench:
        bench = self._loop.robot.bench
        if bench is None:
            raise Refused(
                "simulated", "a simulated fish has nothing to calibrate; see robot: virtual-pi"
            )
        return bench

    def _resting_bench(self) -> Bench:
        """The bench, while nothing swims; `hold` may be in command."""
        bench = self._bench()
        loop = self._loop
        if loop.supervisor.mode is Mode.RUNNING and loop.controller_name != "hold":
            raise Refused(
                "running", f"{loop.controller_name} is in command; stop it with 'fishctl stop'"
            )
        return bench

    async def _save(self, calibration: C) -> tuple[C, Path]:
        try:
            return await asyncio.to_thread(self._folder.save, calibration, self._date())
        except ConfigError as error:
            raise Refused("not-saved", str(error)) from None
        except OSError as error:
            raise Refused(
                "not-saved", f"{self._folder.folder}: cannot be written: {error.strerror}"
            ) from None

    def _file(self, kind: type[C]) -> str | None:
        found = self._folder.newest(kind) if self._loop.robot.bench else None
        return str(found[1]) if found else None

    def _date(self) -> datetime.datetime:
        return datetime.datetime.fromtimestamp(self._clock.wall()).astimezone()

    def _announce(self, what: str, path: Path) -> None:
        self._loop.reporter.event("calibration", f"{what}: {path}", file=str(path))
