"""`thrust`: it holds a wanted mean thrust by the amplitude, and says how well, and where not."""

from collections.abc import Sequence

import pytest
from rigs.harness import LIMITS, Rig, observe

from fishd.controllers import registry
from fishd.controllers.thrust import MIN_AMPLITUDE_FRACTION
from fishd.controllers.thrust_gauge import ThrustGauge, mean_of_ripple
from fishd.core.errors import ParameterError
from fishd.core.signals import Tick

K = 12.9e-3
FACTOR = 68.4
"""Thrust over the mean square of the fin velocity that the default fish is seen to have [N]."""
RIG = ("simulation.noise=1e-3", "simulation.offset_y=0.02", "simulation.drift=5e-3")


def true_thrust(ticks: Sequence[Tick], coefficient: float = K) -> float:
    """K times the mean square of the fin velocity, over whole beats [N]."""
    ups = [k for k in range(1, len(ticks)) if ticks[k - 1].phi_c <= 0.0 < ticks[k].phi_c]
    beats = ticks[ups[0] : ups[-1]]
    return coefficient * sum(float(tick.alpha_rate) ** 2 for tick in beats) / len(beats)  # type: ignore[arg-type]


def last_quantities(ticks: Sequence[Tick]) -> dict[str, float]:
    quantities = ticks[-1].quantities
    assert isinstance(quantities, dict)
    return quantities


def rested(*overrides: str, factor: float | None = FACTOR) -> Rig:
    """Return the rig of a fish at rest; factor: measured thrust factor [N]."""
    rig = Rig(*RIG, *overrides)
    rig.run_for(3)
    if factor is not None:
        rig.loop.perception.thrust.calibrate(factor, 0.006 * factor)
    return rig


@pytest.mark.parametrize("target", [0.004, 0.008, 0.014])
def test_with_a_measured_factor_it_holds_the_target_within_five_seconds(target: float) -> None:
    rig = rested()
    rig.start("thrust", target=target)
    rig.run_for(5)
    assert true_thrust(rig.run_for(4)) == pytest.approx(target, rel=0.02)
    assert true_thrust(rig.run_for(20)) == pytest.approx(target, rel=0.01)


def test_with_nothing_known_it_goes_by_the_ripple_and_says_how_badly_it_knows() -> None:
    rig = Rig(*RIG).start("thrust", target=0.010)
    rig.run_for(10)
    ticks = rig.run_for(20)
    assert true_thrust(ticks) == pytest.approx(0.010, rel=0.08)
    error = last_quantities(ticks)["held_thrust_ci95"] / last_quantities(ticks)["held_thrust"]
    assert 0.1 < error < 0.3


def test_a_model_of_the_fish_is_believed_and_the_drift_of_the_sensor_is_not() -> None:
    rig = rested("estimator.kind=observer", "simulation.drift=0.02", factor=None)
    rig.start("thrust", target=0.010)
    rig.run_for(6)
    assert true_thrust(rig.run_for(20)) == pytest.approx(0.010, rel=0.02)


def test_another_target_is_held_within_five_seconds_and_the_factor_stays_known() -> None:
    rig = rested()
    rig.start("thrust", target=0.012)
    rig.run_for(8)
    for target in (0.006, 0.012):
        rig.retune(target=target)
        on_its_way = [last_quantities([tick])["saturated"] for tick in rig.run_for(5)]
        assert set(on_its_way) == {0.0}  # no limit of the amplitude is in the way
        ticks = rig.run_for(10)
        assert true_thrust(ticks) == pytest.approx(target, rel=0.03)
        assert last_quantities(ticks)["held_thrust_ci95"] < 0.2 * target


def test_more_than_the_amplitude_limit_gives_is_held_there_and_told() -> None:
    rig = rested()
    rig.start("thrust", target=0.040)
    ticks = rig.run_for(15)
    assert last_quantities(ticks)["saturated"] == 1.0
    assert abs(ticks[-1].phi_c) == rig.config.amplitude_limit
    rig.retune(target=0.010)
    assert last_quantities(rig.run_for(10))["saturated"] == 0.0
    rig.retune(target=0.020, amplitude=0.2)
    ticks = rig.run_for(8)
    assert max(abs(tick.phi_c) for tick in ticks) == 0.2
    assert last_quantities(ticks)["saturated"] == 1.0


def test_less_than_the_smallest_amplitude_gives_is_held_there_and_told() -> None:
    rig = rested()
    rig.start("thrust", target=1e-6)
    ticks = rig.run_for(15)
    assert last_quantities(ticks)["saturated"] == -1.0
    least = MIN_AMPLITUDE_FRACTION * rig.config.amplitude_limit
    assert abs(ticks[-1].phi_c) == pytest.approx(least)
    assert ticks[-1].frequency > 0.5


def test_it_finds_the_target_again_with_another_fin() -> None:
    rig = rested(factor=None)
    rig.start("thrust", target=0.010)
    rig.run_for(10)
    coefficient = 0.03
    rig.change_fin(coefficient)
    assert true_thrust(rig.run_for(3), coefficient) < 0.008
    rig.run_for(25)
    assert true_thrust(rig.run_for(10), coefficient) == pytest.approx(0.010, rel=0.15)


def test_what_was_measured_of_swing_holds_for_it() -> None:
    rig = rested(factor=None)
    rig.start("swing")
    rig.run_for(8)
    rig.loop.stop()
    rig.run_for(3)
    rig.loop.perception.thrust.calibrate(FACTOR, 0.006 * FACTOR)
    rig.start("thrust", target=0.020)
    known = rig.run(1)[-1]
    assert known.thrust_factor == pytest.approx(FACTOR)
    assert known.thrust_factor_ci95 < 0.05 * FACTOR  # type: ignore[operator]
    rig.start("sine", frequency=1.5)
    assert rig.run(1)[-1].thrust_factor_ci95 > 0.3 * FACTOR  # type: ignore[operator]


def test_the_mean_is_told_from_the_ripple_alone() -> None:
    first, third, phase = 1.0, 0.05, 0.7
    # −αα̈ of α = cos θ + 0.05 cos(3θ + 0.7), seen from a reversal 0.4 rad before θ = 0
    shift = complex(0.0, 1.0) * 0.4
    cross = 5.0 * third * 2.718281828459045 ** complex(0.0, phase)
    turn = 2.718281828459045**shift
    f2 = 0.5 * (0.5 * first + cross) * turn**2
    f4 = 0.5 * cross * turn**4
    assert mean_of_ripple(f2, f4) == pytest.approx(0.5 * (1.0 + 9.0 * third**2), rel=1e-3)
    assert mean_of_ripple(0j, 0j) is None


def test_the_gauge_averages_the_thrust_of_the_last_four_seconds() -> None:
    gauge = ThrustGauge(coefficient=1.0)
    shown = []
    for speed, half_beats in ((1.0, 60), (2.0, 18), (1.0, 8)):  # of 0.25 s
        for tick in range(5 * half_beats):
            side = 0.4 if tick // 5 % 2 else -0.4
            gauge.update(observe(angle=side, fin_velocity=speed))
        shown.append((gauge.thrust, gauge.latest))
    assert shown[0] == pytest.approx((1.0, 1.0))
    assert shown[1] == pytest.approx((4.0, 4.0))
    assert shown[2] == pytest.approx((2.5, 1.0), rel=0.1)  # two seconds of each


@pytest.mark.parametrize("target", [0, -0.01, float("nan"), float("inf")])
def test_a_target_that_is_no_thrust_is_refused_in_a_line(target: float) -> None:
    problem = r"thrust: target: \S+ is not valid: a number in \(0, 10\] N is needed$"
    with pytest.raises(ParameterError, match=problem):
        registry.create("thrust", {"target": target}, LIMITS)
