"""The live thrust and its confidence interval."""

from collections.abc import Sequence

import pytest
from msgspec import UNSET
from msgspec.structs import replace
from rigs.harness import PINNED_TICK, Rig, Wrapped, fragile_rig

from fishd.config import load
from fishd.core.signals import Tick
from fishd.lab.session import VirtualSession

CONFIG = load(None, [PINNED_TICK, "simulation.drift=0.005", "simulation.noise=0.001"])
TRUTH = 25.74e-3


def rig(seed: int = 0) -> VirtualSession:
    return VirtualSession(replace(CONFIG, simulation=replace(CONFIG.simulation, seed=seed)))


def thrust_and_ci95(ticks: Sequence[Tick]) -> tuple[float, float]:
    """Return the thrust of the last tick, and the half-width of its interval [N]."""
    error = ticks[-1].thrust_ci95
    assert error is not UNSET
    return ticks[-1].thrust, error


def test_nothing_is_known_of_a_fish_that_never_rested() -> None:
    with rig() as fish:
        ticks = fish.swim("swing", {}, 30.0)
        assert {tick.thrust_ci95 for tick in ticks} == {UNSET}
        assert ticks[-1].thrust == pytest.approx(TRUTH, abs=8e-3)  # as the sensor shows it


@pytest.mark.slow
def test_after_a_rest_of_three_seconds_the_interval_contains_the_truth() -> None:
    for seed in range(5):
        with rig(seed) as fish:
            fish.rest(3.0)
            thrust, error = thrust_and_ci95(fish.swim("swing", {}, 1.5))  # the first whole beats
            assert abs(thrust - TRUTH) < error < 8e-3
            for _ in range(3):
                thrust, error = thrust_and_ci95(fish.swim("swing", {}, 20.0))
                assert abs(thrust - TRUTH) < error < 5e-3


@pytest.mark.slow
def test_the_interval_shrinks_with_each_change_and_grows_with_time() -> None:
    with rig() as fish:
        fish.rest(3.0)
        _, first = thrust_and_ci95(fish.swim("swing", {}, 8.0))
        fish.rest(3.0)
        _, second = thrust_and_ci95(fish.swim("swing", {}, 8.0))
        _, later = thrust_and_ci95(fish.swim("swing", {}, 600.0))
        assert second < 0.8 * first
        assert later > second


def test_two_rests_of_a_quiet_sensor_give_the_thrust_to_five_percent() -> None:
    with VirtualSession(load(None, [PINNED_TICK])) as fish:
        for _ in range(2):
            fish.rest(3.0)
            ticks = fish.swim("swing", {}, 30.0)
        thrust, ci95 = thrust_and_ci95(ticks)
        assert abs(thrust - TRUTH) < ci95 < 0.05 * TRUTH


@pytest.mark.slow
def test_a_measured_thrust_is_known_to_four_percent_for_an_hour() -> None:
    with rig() as fish:
        ticks = fish.swim("swing", {}, 20.0)
        power = sum(tick.fin_velocity**2 for tick in ticks[-240:]) / 240
        fish._run.loop.perception.thrust.calibrate(TRUTH / power, 0.2e-3 / power)
        thrust, ci95 = thrust_and_ci95(fish.swim("swing", {}, 3600.0))
        assert abs(thrust - TRUTH) < ci95 < 0.04 * TRUTH


def test_a_tail_that_does_not_move_rests_whichever_controller_is_active() -> None:
    with rig() as fish:
        _, error = thrust_and_ci95(fish.swim("hold", {}, 6.0))
        assert error < 3e-3


def test_a_measured_factor_is_used_at_once_and_without_a_zero() -> None:
    with rig() as fish:
        ticks = fish.swim("swing", {}, 20.0)
        power = sum(tick.fin_velocity**2 for tick in ticks[-240:]) / 240
        fish._run.loop.perception.thrust.calibrate(TRUTH / power, 0.2e-3 / power)
        thrust, error = thrust_and_ci95(fish.swim("swing", {}, 8.0))
        assert thrust == pytest.approx(TRUTH, abs=0.3e-3)
        assert 0.01 * TRUTH < error < 0.6e-3  # no wave is known better


def test_the_interval_of_a_measured_factor_is_the_measured_one() -> None:
    with rig() as fish:
        fish._run.loop.perception.thrust.calibrate(68.4, 20.0)
        fish.rest(1.0)
        assert fish._run.loop.perception.thrust.factor == pytest.approx((68.4, 20.0), rel=0.01)


def test_a_new_zero_of_the_sensor_is_found_again_and_the_factor_stays() -> None:
    with rig() as fish:
        fish.rest(3.0)
        fish.swim("swing", {}, 8.0)
        fish._run.loop.perception.thrust.forget_zero()
        assert abs(thrust_and_ci95(fish.swim("swing", {}, 8.0))[0] - TRUTH) < 3e-3
        fish._run.loop.perception.thrust.forget()
        assert fish.swim("swing", {}, 8.0)[-1].thrust_ci95 is UNSET


@pytest.mark.parametrize("leak", [0.1, 0.3, 1.0])
def test_a_wave_for_which_the_factor_is_another_is_known_soon(leak: float) -> None:
    config = replace(CONFIG, estimator=replace(CONFIG.estimator, leak=leak))
    with VirtualSession(config) as fish:
        fish.rest(3.0)
        fish.swim("square", {"frequency": 5.0 / 3.0}, 8.0)
        for frequency, truth in ((1.0, 15.23e-3), (2.0, 23.83e-3), (0.5, 7.26e-3)):
            fish.rest(3.0)
            for seconds in (5.0, 15.0):
                ticks = fish.swim("square", {"frequency": frequency}, seconds)
                thrust, error = thrust_and_ci95(ticks)
                assert abs(thrust - truth) < error < 4e-3
        for frequency, truth in ((1.0, 15.23e-3), (2.0, 23.83e-3)):  # without a rest between
            thrust, error = thrust_and_ci95(fish.swim("square", {"frequency": frequency}, 8.0))
            assert abs(thrust - truth) < error < 6e-3


@pytest.mark.parametrize("noise", [1e-3, 1e-2])
def test_at_rest_the_interval_includes_the_noise(noise: float) -> None:
    outside = 0
    for seed in range(8):
        config = replace(CONFIG, simulation=replace(CONFIG.simulation, seed=seed, noise=noise))
        with VirtualSession(config) as fish:
            ticks = fish.rest(20.0)[100:]
            outside += sum(abs(tick.thrust) > tick.thrust_ci95 for tick in ticks)  # type: ignore[operator]
    assert outside < 0.1 * 8 * len(ticks)


def test_a_rest_with_a_larger_drift_widens_later_intervals() -> None:
    errors = []
    for drift in (0.0, 2e-3):
        config = replace(CONFIG, simulation=replace(CONFIG.simulation, drift_walk=drift))
        with VirtualSession(config) as fish:
            for _ in range(4):
                fish.rest(3.0)
                ticks = fish.swim("swing", {}, 12.0)
        errors.append(thrust_and_ci95(ticks)[1])
    assert errors[1] > 1.5 * errors[0]


def test_a_factor_that_overflows_does_not_stop_the_fish() -> None:
    with rig() as fish:
        fish.rest(3.0)
        fish.swim("swing", {}, 6.0)
        fish._run.loop.perception.thrust.calibrate(1e150, 1e150)
        ticks = fish.swim("swing", {}, 10.0)
        assert {tick.mode for tick in ticks} == {"running"}


def clip(rig: Rig, robot: Wrapped, fx: float) -> None:
    """Run one tick with a suspect force."""
    robot.fx, robot.suspect = fx, "F_x is clipped"
    rig.run(1)
    robot.fx, robot.suspect = None, None


def test_beats_that_are_old_because_of_suspect_forces_are_not_shown() -> None:
    rig, robot = fragile_rig()
    rig.run_for(3.0)
    rig.start("square", frequency=5.0 / 3.0)
    thrust = rig.run_for(5.0)[-1].thrust
    for _ in range(15):  # too short for a whole beat between the suspect ticks
        clip(rig, robot, 0.1)
        ticks = rig.run_for(0.8)
    assert ticks[-1].thrust != thrust
    assert thrust_and_ci95(ticks)[1] > 3e-3


@pytest.mark.parametrize("fx", [0.1, -5.0])
def test_a_suspect_force_at_rest_does_not_change_the_zero(fx: float) -> None:
    rig, robot = fragile_rig()
    rig.run_for(2.75)
    clip(rig, robot, fx)
    rig.run_for(0.2)
    rig.start("square", frequency=5.0 / 3.0)
    thrust, error = thrust_and_ci95(rig.run_for(30))
    assert abs(thrust - TRUTH) < error < 3e-3


@pytest.mark.parametrize("fx", [1.0, -5.0])
def test_one_suspect_force_in_a_beat_does_not_change_the_thrust(fx: float) -> None:
    rig, robot = fragile_rig()
    rig.run_for(3.0)
    rig.start("square", frequency=5.0 / 3.0)
    rig.run_for(10.0)
    for ticks in range(40, 52):  # each tick of a beat once, the reversals among them
        clip(rig, robot, fx)
        thrust, error = thrust_and_ci95(rig.run(ticks))
        assert abs(thrust - TRUTH) < error < 3e-3


@pytest.mark.parametrize("tick", [43, 57, 59])
@pytest.mark.parametrize("fx", [0.2, -5.0])
def test_a_spike_that_is_not_suspect_widens_the_interval_of_zero(fx: float, tick: int) -> None:
    rig, robot = fragile_rig()
    rig.run(tick)
    robot.fx = fx
    rig.run(1)
    robot.fx = None
    rig.run(60 - tick)
    rig.start("square", frequency=5.0 / 3.0)
    ticks = rig.run_for(30)
    if ticks[-1].thrust_ci95 is not UNSET:
        thrust, error = thrust_and_ci95(ticks)
        assert abs(thrust - TRUTH) < error
    rig.loop.stop()
    rig.run_for(3.0)
    rig.start("square", frequency=5.0 / 3.0)
    thrust, error = thrust_and_ci95(rig.run_for(30))
    assert abs(thrust - TRUTH) < error < 3e-3


@pytest.mark.parametrize("load", [0.05, -2.0, 300.0])
def test_a_load_that_stays_is_the_zero_after_two_pieces_of_a_rest(load: float) -> None:
    rig, robot = fragile_rig()
    rig.run_for(3.0)
    robot.fx = load
    thrust, error = thrust_and_ci95(rig.run_for(1.7))
    assert abs(thrust) < error < 4e-3


@pytest.mark.parametrize("loads", [(0.05, -2.0), (5.0, 0.05), (0.05, 0.1)])
def test_after_two_different_loads_in_a_rest_the_thrust_is_not_known(
    loads: tuple[float, float],
) -> None:
    rig, robot = fragile_rig()
    rig.run_for(3.0)
    for fx in loads:  # each for a piece of the rest
        robot.fx = fx
        rig.run_for(0.6)
    robot.fx = None
    rig.start("square", frequency=5.0 / 3.0)
    assert rig.run_for(10)[-1].thrust_ci95 is UNSET
