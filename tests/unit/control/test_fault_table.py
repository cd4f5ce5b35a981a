"""The fault table, row by row: the failure, the pulses of the servo, and the recovery."""

import math
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.harness import Recorder, Scripted, fragile_rig
from rigs.lockstep_rig import NEUTRAL, LockstepRig, lockstep_rig

from fishd.config import load
from fishd.control.estimators.lateral_force import LateralForceEstimator
from fishd.control.faults import FAULTS, UNLISTED
from fishd.control.guard import Guard
from fishd.controllers.swing import Swing
from fishd.core.signals import Reason, Tick
from fishd.hardware.force_sensor.sampled_sensor import SampledSensor
from fishd.lab.simulation import simulate
from fishd.virtual.pi.faults import TRANSFER_ERRORS

# By fault of the virtual Pi: code, and earliest and latest time of the latched fault [s].
# A sample is too old after two periods, and three bad reads in a row are a fault.
SENSOR_FAULTS = {
    **dict.fromkeys(TRANSFER_ERRORS, ("sensor-stale", 0.0, 0.30)),
    "unplugged": ("sensor-stale", 0.0, 0.30),
    "stuck-busy": ("sensor-stale", 0.0, 0.30),
    "clipped": ("sensor-range", 0.15, 0.15),
    "frozen-code": ("sensor-range", 2.0, 2.25),
}
FADE_S = 0.57
"""Time of a fade from Φ to neutral, of the settling of the servo, and of the last frame [s]."""


@pytest.fixture
def data_rate() -> int:
    """Conversions of the force sensor per second: few, where another part fails."""
    return 250


@pytest.fixture
def rig(tmp_path: Path, data_rate: int) -> Iterator[LockstepRig]:
    with lockstep_rig(tmp_path, f"force_sensor.data_rate={data_rate}") as rig:
        rig.start("swing")
        rig.run_for(1.0)
        assert rig.mode == "running"
        yield rig


def assert_neutral_then_off(rig: LockstepRig, since: float, limit: float) -> None:
    """Assert that the pulses came to neutral and then ended, within `limit` [s] of `since`."""
    rig.run_for(since + limit - rig.now)
    changes = rig.pulses_since(since)
    *_, (_, last), (ended, off) = changes
    assert off == 0.0
    assert last == pytest.approx(NEUTRAL, abs=5)
    assert ended - since <= limit
    rig.run_for(1.0)
    assert rig.pulses_since(ended)[1:] == []  # and did not start again
    assert not rig.recorder.ticks[-1].servo_on


def assert_one_fault(rig: LockstepRig, code: str) -> None:
    assert (rig.mode, rig.reason) == ("fault", code)
    assert rig.recorder.kinds().count("fault") == 1
    assert rig.loop.active.name == "hold"


def assert_recovers_by_clear_fault_only(rig: LockstepRig) -> None:
    rig.run_for(2.0)
    assert rig.mode == "fault"
    assert rig.pulse == 0.0
    rig.loop.clear_fault()
    rig.run_for(1.0)
    assert rig.mode == "idle", rig.loop.supervisor.reason
    assert rig.pulse == pytest.approx(NEUTRAL, abs=5)
    rig.start("swing")
    start = rig.now
    while rig.run_for(0.5)[-1].thrust <= 0.015:
        assert rig.now - start < 5.0
    assert rig.mode == "running"


@pytest.mark.parametrize("code", [*FAULTS, "a code of another package"])
def test_the_servo_gets_what_the_row_of_a_latched_fault_says(code: str) -> None:
    rig, robot = fragile_rig()
    rig.start("square")
    rig.run(2)
    rig.loop.supervisor.fail(code, "it broke")
    row = FAULTS.get(code, UNLISTED)
    assert rig.loop.supervisor.reason == Reason(code, "it broke", row.remedy)
    released = row.releases
    assert (robot.log[-1] is None) is released
    ticks = rig.run(12)
    assert {tick.mode for tick in ticks} == {"estop" if released else "fault"}
    assert {tick.controller for tick in ticks} == {"hold"}
    assert (0.0 in robot.log) is not released
    assert robot.log[-1] is None
    assert rig.recorder.kinds() == ["controller", "mode", "mode" if released else "fault"]


@pytest.mark.parametrize(
    ("name", "data_rate"),
    [(name, 250 if name in TRANSFER_ERRORS else 860) for name in SENSOR_FAULTS],
)
def test_a_bad_force_ends_in_neutral_until_it_is_cleared(rig: LockstepRig, name: str) -> None:
    code, earliest, latest = SENSOR_FAULTS[name]
    broke = rig.now
    rig.pi.faults.inject(name)
    assert earliest - 1e-9 <= rig.run_until_fault(3.0) <= latest + 1e-9
    assert_one_fault(rig, code)
    assert_neutral_then_off(rig, broke, limit=latest + FADE_S)
    rig.pi.faults.clear()
    assert_recovers_by_clear_fault_only(rig)


def test_the_extremes_of_a_window_enclose_its_mean(rig: LockstepRig) -> None:
    for tick in rig.run_for(2.0):
        assert tick.fx_min < tick.fx < tick.fx_max
        assert tick.fy_min < tick.fy < tick.fy_max


def test_a_force_beyond_its_limit_is_a_fault(tmp_path: Path) -> None:
    with lockstep_rig(tmp_path, "force_sensor.force_limit=0.1") as rig:
        rig.start("square")
        rig.run_until_fault(5.0)
        assert_one_fault(rig, "sensor-range")
        assert "force_sensor.force_limit" in rig.loop.supervisor.reason.message
        assert_neutral_then_off(rig, rig.now, limit=FADE_S)


def test_after_a_pigpiod_that_was_gone_pulses_come_only_with_a_clear(rig: LockstepRig) -> None:
    broke = rig.now
    rig.pi.faults.inject("pigpiod-gone", 1.0)
    assert rig.run_until_fault(1.0) <= 0.10
    assert_one_fault(rig, "servo-link")
    rig.run_for(3.0)  # pigpiod has run again for two seconds
    assert [width for _, width in rig.pulses_since(broke + 0.1)] in ([], [0.0])
    assert_recovers_by_clear_fault_only(rig)


def test_a_pigpiod_that_restarts_is_a_fault_and_gets_its_script_again(rig: LockstepRig) -> None:
    rig.pi.faults.inject("pigpiod-restart")
    rig.run_until_fault(1.0)
    assert_one_fault(rig, "servo-link")
    assert_recovers_by_clear_fault_only(rig)
    silent = rig.now
    rig.robot.sensor.read(rig.now + 1.5)  # time passes, and the loop hangs
    widths = [width for _, width in rig.pulses_since(silent)]
    assert widths[-2:] == [NEUTRAL, 0.0]


def test_a_pigpiod_that_hangs_is_a_fault_and_is_released_when_it_wakes(rig: LockstepRig) -> None:
    rig.pi.faults.inject("pigpiod-frozen", 1.0)
    assert 0.10 < rig.run_until_fault(1.0) <= 0.16  # in the third tick
    assert_one_fault(rig, "servo-link")
    assert rig.pulse != 0.0  # a daemon that hangs cannot stop the pulses
    rig.run_for(2.5)
    assert rig.pulse == 0.0
    assert "servo" in rig.recorder.kinds()
    assert_recovers_by_clear_fault_only(rig)


@pytest.mark.parametrize(
    ("part", "method", "reason"),
    [
        (SampledSensor, "read", "sensor-stale"),
        (LateralForceEstimator, "update", "estimate-error"),
        (Swing, "update", "controller-error"),
        (Guard, "apply", "controller-error"),
        (Recorder, "tick", "publish-error"),
    ],
)
def test_an_exception_in_any_phase_ends_in_neutral_and_the_loop_goes_on(
    rig: LockstepRig, monkeypatch: pytest.MonkeyPatch, part: type, method: str, reason: str
) -> None:
    broke = rig.now
    with monkeypatch.context() as broken:
        broken.setattr(part, method, lambda *_: 1 / 0)
        rig.run_until_fault(1.0)
        if part is SampledSensor:  # its read advances the time
            monkeypatch.undo()
    assert_one_fault(rig, reason)
    rig.run_for(1.0)
    assert_neutral_then_off(rig, broke, limit=1.5)
    assert_recovers_by_clear_fault_only(rig)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_an_estimate_that_is_not_finite_is_a_fault_and_is_not_kept(
    rig: LockstepRig, monkeypatch: pytest.MonkeyPatch, value: float
) -> None:
    rig.loop.stop()
    rig.run_for(3.0)  # so that the zero of the force is known
    rig.start("swing")
    rig.run_for(2.5)
    broke = rig.now
    with monkeypatch.context() as broken:
        broken.setattr(LateralForceEstimator, "fin_velocity", lambda *_: value)
        rig.run(1)
    assert_one_fault(rig, "estimate-error")
    assert math.isfinite(rig.recorder.ticks[-1].fin_velocity)
    assert_neutral_then_off(rig, broke, limit=0.05 + FADE_S)
    assert_recovers_by_clear_fault_only(rig)
    thrust, error = rig.loop.perception.known_thrust
    assert math.isfinite(thrust + error)


def test_a_controller_that_takes_half_the_period_ends_in_neutral(rig: LockstepRig) -> None:
    def dawdle(_: object) -> float:
        rig.clock.now += 0.026
        return 0.4

    broke = rig.now
    rig.start(Scripted(dawdle))
    assert rig.run_until_fault(1.0) == pytest.approx(0.15)
    assert_one_fault(rig, "controller-slow")
    assert_neutral_then_off(rig, broke, limit=0.15 + FADE_S)
    assert_recovers_by_clear_fault_only(rig)


def test_many_overruns_end_in_neutral(rig: LockstepRig, monkeypatch: pytest.MonkeyPatch) -> None:
    record = Recorder.tick

    def dawdle(recorder: Recorder, tick: Tick) -> None:
        rig.clock.now += 0.051
        record(recorder, tick)

    broke = rig.now
    with monkeypatch.context() as slow:
        slow.setattr(Recorder, "tick", dawdle)
        assert rig.run_until_fault(3.0) == pytest.approx(21 * 0.05)
    assert_one_fault(rig, "overrun")
    assert_neutral_then_off(rig, broke, limit=21 * 0.05 + FADE_S)
    assert_recovers_by_clear_fault_only(rig)


def test_a_sensor_and_a_servo_that_fail_together_are_both_survived(rig: LockstepRig) -> None:
    rig.pi.faults.inject("unplugged")
    rig.pi.faults.inject("pigpiod-gone")
    rig.run_until_fault(1.0)
    rig.run_for(3.0)
    rig.pi.faults.clear()
    assert_recovers_by_clear_fault_only(rig)


def test_an_emergency_stop_ends_the_pulses_within_one_frame(rig: LockstepRig) -> None:
    stopped = rig.now
    rig.loop.estop("test")
    rig.run_for(0.1)
    (ended, width), *rest = rig.pulses_since(stopped)
    assert (width, rest) == (0.0, [])
    assert ended - stopped <= 0.025


@pytest.mark.slow
def test_swing_reaches_the_best_square_wave_through_the_whole_hardware_path() -> None:
    overrides = ["robot=virtual-pi", "simulation.noise=0.001", "force_sensor.full_scale=2.048"]
    report = simulate(load(None, overrides), "swing", {"C": 0.6}, seconds=12.0, settle=6.0)
    assert report.relative_thrust >= 0.95
