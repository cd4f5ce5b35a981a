"""Requests about calibrations, on the virtual Pi in virtual time."""

import asyncio
from collections.abc import Awaitable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from rigs.lockstep_rig import LockstepRig, lockstep_rig

from fishd.assembly import state_folder
from fishd.core.calibration import ForceCalibration, ServoCalibration
from fishd.core.errors import Refused
from fishd.core.protocol import (
    MAX_SAMPLE_AGE_S,
    CalibrateForce,
    CalibrateServo,
    NoArguments,
    SampleForce,
    Tare,
)
from fishd.daemon.calibration_requests import MAX_CONCURRENT_SAMPLES, CalibrationRequests

ANOTHER_BUS = ("force_sensor.bus=2", "virtual_pi.bus=2")
BRIEFLY = SampleForce(seconds=0.2)
FISH = ("virtual_pi.zero_x=0.2", "simulation.noise=0.0002", "force_sensor.data_rate=128")


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[LockstepRig]:
    with lockstep_rig(tmp_path, *FISH) as rig:
        rig.run_for(0.5)
        yield rig


def on_trial(rig: LockstepRig, calibration: ServoCalibration) -> tuple[str, CalibrateServo]:
    """Return a request to try a calibration under a new lease."""
    lease = rig.loop.lease.take("calibrate", "", 0, 60.0)
    return "calibrate-servo", CalibrateServo(calibration, lease=lease)


def perform(
    rig: LockstepRig, handler: CalibrationRequests, *requests: tuple[str, Any]
) -> list[Any]:
    """Return the answers to simultaneous requests, while the loop ticks.

    The loop is at most five times as fast as real time. A tare uses a sample that is taken first.
    """

    async def answer(name: str, arguments: Any) -> Any:
        if name == "tare" and isinstance(arguments, SampleForce):
            sample = await handler.handlers["sample-force"](arguments)
            arguments = Tare(sample.number)
        return await handler.handlers[name](arguments)

    async def run() -> list[Any]:
        answers: Awaitable[list[Any]] = asyncio.gather(*(answer(*request) for request in requests))
        task = asyncio.ensure_future(answers)
        while not task.done():
            rig.run_for(rig.config.tick)
            await asyncio.sleep(0.01)
        return await task

    return asyncio.run(run())


def calibration_requests(rig: LockstepRig) -> CalibrationRequests:
    return CalibrationRequests(rig.loop, rig.clock, rig.config, state_folder(rig.config))


def test_a_tare_takes_the_present_force_away_and_keeps_the_rest(rig: LockstepRig) -> None:
    handler = calibration_requests(rig)
    (after,) = perform(rig, handler, ("tare", BRIEFLY))
    assert after.force.x0 == pytest.approx(-0.2, abs=1e-3)
    assert (after.force.xx, after.force.yy) == (1.0, 1.0)
    assert after.force.tare_date
    assert rig.run_for(0.5)[-1].fx == pytest.approx(0.0, abs=2e-3)
    assert Path(after.force_file).exists()


@pytest.mark.parametrize("kind", ["lateral_force", "observer"])
def test_after_a_tare_swing_beats_as_if_it_was_always_zero(tmp_path: Path, kind: str) -> None:
    beats = []
    for zero in (0.0, 0.9):
        overrides = (f"virtual_pi.zero_y={zero}", f"estimator.kind={kind}")
        with lockstep_rig(tmp_path / f"{zero}", *FISH, *overrides) as rig:
            rig.run_for(1.0)
            perform(rig, calibration_requests(rig), ("tare", BRIEFLY))
            assert rig.run(220 - rig.index)  # so that swing always starts at the same tick
            rig.start("swing")
            angles = [tick.phi_c for tick in rig.run_for(6.0)]
        reversals = [k for k, (a, b) in enumerate(pairwise(angles)) if a * b < 0.0]
        beats.append([b - a for a, b in pairwise([0, *reversals])])
    still, tared = beats
    assert len(tared) == len(still)
    assert all(abs(a - b) <= 1 for a, b in zip(tared, still, strict=True)), beats


def test_a_tare_alone_is_no_calibration(rig: LockstepRig, tmp_path: Path) -> None:
    not_calibrated = "the force is not calibrated, and shown in V: fishctl calibrate force"
    handler = calibration_requests(rig)
    perform(rig, handler, ("tare", BRIEFLY))
    assert not_calibrated in rig.robot.limitations()
    assert rig.robot.force_unit == "V"
    with lockstep_rig(tmp_path, *ANOTHER_BUS) as again:
        assert not_calibrated in again.robot.limitations()
    fitted = ForceCalibration(x0=-0.2, loads=5)
    perform(rig, handler, ("calibrate-force", CalibrateForce(fitted)))
    assert not_calibrated not in rig.robot.limitations()
    assert rig.robot.force_unit == "N"


def test_two_tares_at_the_same_time_are_one(rig: LockstepRig) -> None:
    handler = calibration_requests(rig)
    perform(rig, handler, ("tare", BRIEFLY), ("tare", BRIEFLY), ("tare", SampleForce(seconds=0.3)))
    assert rig.run_for(0.5)[-1].fx == pytest.approx(0.0, abs=2e-3)
    (present,) = perform(rig, handler, ("calibrations", NoArguments()))
    assert present.force.x0 == pytest.approx(-0.2, abs=1e-3)


def test_a_sample_alone_changes_nothing(rig: LockstepRig) -> None:
    handler = calibration_requests(rig)
    perform(rig, handler, ("sample-force", BRIEFLY))
    (present,) = perform(rig, handler, ("calibrations", NoArguments()))
    assert (present.force.x0, present.force_file) == (0.0, None)


def test_four_samples_at_once_are_all(rig: LockstepRig) -> None:
    handler = calibration_requests(rig)

    async def ask(request: SampleForce) -> Any:
        try:
            return await handler.handlers["sample-force"](request)
        except Refused as refusal:
            return refusal.code

    async def run() -> list[Any]:
        answers = asyncio.gather(*(ask(BRIEFLY) for _ in range(MAX_CONCURRENT_SAMPLES + 3)))
        while not answers.done():
            rig.run_for(rig.config.tick)
            await asyncio.sleep(0)
        return await answers

    answers = asyncio.run(run())
    assert answers.count("busy") == 3
    assert all(answer.pairs for answer in answers if answer != "busy")
    (again,) = perform(rig, handler, ("sample-force", BRIEFLY))
    assert again.pairs


def test_samples_that_are_under_way_end_as_soon_as_a_controller_starts(rig: LockstepRig) -> None:
    handler = calibration_requests(rig)

    async def run() -> list[Any]:
        long = SampleForce(seconds=60.0)
        request = handler.handlers["sample-force"]
        requests = (request(long) for _ in range(MAX_CONCURRENT_SAMPLES))
        answers = asyncio.gather(*requests, return_exceptions=True)
        await asyncio.sleep(0.1)
        rig.start("square")
        return await asyncio.wait_for(answers, 30.0)

    refusals = asyncio.run(run())
    assert [refusal.code for refusal in refusals] == ["running"] * MAX_CONCURRENT_SAMPLES
    assert str(refusals[0]) == "square is the active controller; stop it with 'fishctl stop'"


def test_a_sample_is_good_for_a_tare_only_while_it_is_fresh(rig: LockstepRig) -> None:
    handler = calibration_requests(rig)
    (sample,) = perform(rig, handler, ("sample-force", BRIEFLY))
    rig.run_for(MAX_SAMPLE_AGE_S + 1.0)
    for number in (sample.number, sample.number + 1, 0):
        with pytest.raises(Refused, match=f"sample {number} does not exist or is older") as refusal:
            perform(rig, handler, ("tare", Tare(number)))
        assert refusal.value.code == "no-samples"


def test_what_was_saved_is_in_force_at_the_next_start(rig: LockstepRig, tmp_path: Path) -> None:
    force, servo = ForceCalibration(xx=2.0), ServoCalibration(trim=30.0)
    calibrated = CalibrateServo(servo, save=True)
    requests = (("calibrate-force", CalibrateForce(force)), ("calibrate-servo", calibrated))
    perform(rig, calibration_requests(rig), *requests)
    assert rig.run_for(0.5)[-1].fx == pytest.approx(0.4, abs=5e-3)
    assert rig.pulse == pytest.approx(1530.0)
    with lockstep_rig(tmp_path, *ANOTHER_BUS) as again:
        again.run_for(0.2)
        assert again.pulse == pytest.approx(1530.0)
        assert again.robot.calibrated is not None
        assert again.robot.calibrated.sensor.calibration.xx == 2.0


def test_a_servo_calibration_that_is_not_saved_is_gone_at_the_next_start(
    rig: LockstepRig, tmp_path: Path
) -> None:
    perform(rig, calibration_requests(rig), on_trial(rig, ServoCalibration(trim=30.0)))
    rig.run_for(0.2)
    assert rig.pulse == pytest.approx(1530.0)
    with lockstep_rig(tmp_path, *ANOTHER_BUS) as again:
        again.run_for(0.2)
        assert again.pulse == pytest.approx(1500.0)


def test_new_soft_limits_hold_for_the_next_command(rig: LockstepRig) -> None:
    calibration = ServoCalibration(lowest=-0.1, highest=0.2)
    perform(rig, calibration_requests(rig), on_trial(rig, calibration))
    rig.start("square")
    angles = [tick.phi_c for tick in rig.run_for(3.0)]
    assert (min(angles), max(angles)) == (-0.1, 0.2)
    assert rig.mode == "running"


@pytest.mark.parametrize(
    "change", [{"direction": -1}, {"scale": 900.0}, {"highest": 0.1}], ids=lambda c: next(iter(c))
)
def test_a_calibration_that_would_make_the_tail_jump_is_refused(
    rig: LockstepRig, change: dict[str, Any]
) -> None:
    rig.start("hold", angle=0.3)
    rig.run_for(1.0)
    request = on_trial(rig, replace(ServoCalibration(), **change))
    with pytest.raises(Refused) as refusal:
        perform(rig, calibration_requests(rig), request)
    assert refusal.value.code == "not-neutral"
    rig.run_for(0.5)
    assert rig.mode == "running"
    assert rig.pulse == pytest.approx(1680.0)


def test_nothing_is_measured_or_calibrated_while_the_fish_swims(rig: LockstepRig) -> None:
    handler = calibration_requests(rig)
    rig.start("swing")
    for request in (
        ("tare", BRIEFLY),
        ("sample-force", BRIEFLY),
        ("calibrate-force", CalibrateForce(ForceCalibration())),
        ("calibrate-servo", CalibrateServo(ServoCalibration())),
    ):
        with pytest.raises(Refused) as refusal:
            perform(rig, handler, request)
        assert refusal.value.code == "running"


def test_a_calibration_that_is_unwritten_is_not_in_force(rig: LockstepRig, tmp_path: Path) -> None:
    folder = state_folder(rig.config)
    folder.parent.mkdir(parents=True, exist_ok=True)
    handler = calibration_requests(rig)
    folder.write_text("in the way")
    with pytest.raises(Refused) as refusal:
        perform(rig, handler, ("calibrate-force", CalibrateForce(ForceCalibration(xx=5.0))))
    assert refusal.value.code == "not-saved"
    assert rig.robot.calibrated is not None
    assert rig.robot.calibrated.sensor.calibration.xx == 1.0


@pytest.mark.parametrize(
    "matrix",
    [
        {"xx": 0.0},
        {"yy": 0.0},
        {"xx": 0.0, "yy": 0.0},
        {"xx": 1e-3, "xy": 3e-3, "yx": 1e-3, "yy": 3e-3 * (1 + 1e-7)},
        {"xx": 1e9, "xy": 1e9, "yx": 1e9, "yy": 1e9 + 1e2},
        {"xx": 1e-9},
    ],
)
def test_a_matrix_that_says_the_same_of_both_forces_is_refused(
    rig: LockstepRig, matrix: dict[str, float]
) -> None:
    request = ("calibrate-force", CalibrateForce(ForceCalibration(**matrix)))
    with pytest.raises(Refused, match="xx xy, yx yy is singular"):
        perform(rig, calibration_requests(rig), request)


@pytest.mark.parametrize("size", [1e-6, 1.0, 4.0])
def test_a_matrix_is_judged_by_its_shape_and_not_by_its_size(rig: LockstepRig, size: float) -> None:
    matrix = ForceCalibration(xx=size, xy=0.1 * size, yx=-0.1 * size, yy=8.0 * size)
    (after,) = perform(rig, calibration_requests(rig), ("calibrate-force", CalibrateForce(matrix)))
    assert after.force.yy == 8.0 * size


def test_a_calibration_that_would_be_a_fault_at_once_is_not_saved(rig: LockstepRig) -> None:
    handler = calibration_requests(rig)
    with pytest.raises(Refused, match=r"beyond force_sensor.force_limit, 10 N.*grams") as refusal:
        perform(rig, handler, ("calibrate-force", CalibrateForce(ForceCalibration(xx=100.0))))
    assert refusal.value.code == "too-large"
    (present,) = perform(rig, handler, ("calibrations", NoArguments()))
    assert (present.force_file, present.force_limit) == (None, 10.0)
    good = ForceCalibration(xx=100.0, x0=-20.0)
    perform(rig, handler, ("calibrate-force", CalibrateForce(good)))


def test_a_calibration_can_be_saved_while_the_sensor_says_nothing(rig: LockstepRig) -> None:
    rig.pi.faults.inject("unplugged")
    rig.run_until_fault(3.0)
    request = ("calibrate-force", CalibrateForce(ForceCalibration(xx=100.0)))
    (after,) = perform(rig, calibration_requests(rig), request)
    assert after.force.xx == 100.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scale": 4000.0}, "scale: 4000 is not valid: .*; at most 2380 µs/rad is needed"),
        ({"trim": 500.0, "scale": 1500.0}, "trim: 500 is not valid: .* from 1130 to 1870 µs is"),
        ({"trim": -490.0, "scale": 1500.0, "direction": -1, "lowest": -0.2}, "trim: -490 is not"),
    ],
    ids=["scale", "trim", "direction"],
)
def test_a_servo_calibration_is_saved_only_if_the_configuration_would_take_it(
    rig: LockstepRig, change: dict[str, Any], words: str
) -> None:
    handler = calibration_requests(rig)
    calibration = replace(ServoCalibration(), **change)
    with pytest.raises(Refused, match=f"^{words}") as refusal:
        perform(rig, handler, ("calibrate-servo", CalibrateServo(calibration, save=True)))
    assert refusal.value.code == "bad-arguments"
    (present,) = perform(rig, handler, ("calibrations", NoArguments()))
    assert (present.servo, present.servo_file) == (ServoCalibration(), None)
    within = replace(calibration, lowest=-0.1, highest=0.0)  # smaller soft limits make it valid
    perform(rig, handler, ("calibrate-servo", CalibrateServo(within, save=True)))


def test_a_date_that_a_file_could_not_hold_is_refused(rig: LockstepRig) -> None:
    request = ("calibrate-force", CalibrateForce(ForceCalibration(tare_date="today")))
    with pytest.raises(Refused, match="tare_date: 'today' is not a date: one in ISO 8601"):
        perform(rig, calibration_requests(rig), request)
