"""Swinging control: it starts from rest, never stalls, needs no model, and thrusts as it should."""

import statistics
from itertools import pairwise

import pytest
from rigs.harness import LIMITS, Rig, commands, observe

from fishd.config import load
from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.controllers.reversal import Reversal
from fishd.lab.simulation import simulate

IMPERFECT = ["simulation.noise=1e-3", "simulation.offset_y=0.02", "simulation.drift=0.02"]
SERVO_SPEED_OVER_OMEGA0 = 5.8 / 12.5
DEFAULT_RATIO = 0.42 / SERVO_SPEED_OVER_OMEGA0


def reversals(angles: list[float]) -> list[int]:
    return [k for k, (a, b) in enumerate(pairwise(angles), 1) if a * b < 0]


def feed(speeds: list[float], **parameters: float) -> list[float]:
    """Commands of swing when it is shown these fin velocities."""
    controller = registry.create("swing", parameters, LIMITS)
    controller.activate(observe())
    return [controller.update(observe(fin_velocity=v)) for v in speeds]


def test_it_reverses_when_the_speed_falls_to_that_share_of_the_last_maximum() -> None:
    assert reversals(feed([0.1, 0.6, 1.0, 0.8, 0.61, 0.59, 0.5], C=0.6)) == [5]
    assert reversals(feed([0.1, 0.6, 1.0, 0.8, 0.61, 0.59, 0.5], C=0.9)) == [3]
    assert reversals(feed([0.1, 0.6, 1.0, 0.5, 0.1, -0.01], C=0.0)) == [5]


def test_only_the_shape_of_the_fin_velocity_counts() -> None:
    speeds = [0.0, 0.3, 0.9, 1.0, 0.7, 0.4, -0.2, -0.8, -1.0, -0.7, -0.2, 0.4, 1.0, 0.3]
    assert feed(speeds) == feed([1e-6 * v for v in speeds]) == feed([1e6 * v for v in speeds])


def test_with_a_lead_it_reverses_before_the_fin_slows_down_once_two_beats_are_over() -> None:
    beat = [0.1, 0.6, 0.9, 1.0, 1.05, 1.0, 0.5]
    speeds = [sign * speed for sign in (1, -1, 1, -1, 1, -1) for speed in beat]
    early = reversals(feed(speeds, C=0.95, lead=0.1))
    late = reversals(feed(speeds, C=0.6))
    assert early[:4] == late[:4]
    assert early[4] < late[4]


def test_at_short_ticks_noise_does_not_lead_to_a_predicted_slowdown() -> None:
    reversal = Reversal(Limits(amplitude=0.42, tick=0.01))
    for k in range(100):
        noise = 0.02 * (-1) ** k
        seen = observe(fin_velocity=1.0 + 0.01 * k + noise, dt=0.01)
        reversal.update(seen, C=0.6, lead=0.1, longest=10.0)
        assert reversal.direction == 1.0


def test_without_any_sign_of_slowing_down_it_reverses_after_the_longest_half_period() -> None:
    controller = registry.create("swing", {"longest_half_period": 0.5}, LIMITS)
    assert reversals(commands(controller, 35)) == [9, 19, 29]


@pytest.mark.parametrize("tick", [0.01, 0.05])
def test_a_longer_longest_half_period_changes_nothing_where_the_fin_tells_when(tick: float) -> None:
    swum = []
    for longest in (1.0, 10.0):
        rig = Rig(f"tick={tick}").start("swing", longest_half_period=longest)
        swum.append([tick.phi_c for tick in rig.run_for(15)])
    assert swum[0] == swum[1]


def test_it_takes_over_towards_the_side_that_is_in_force() -> None:
    assert commands(registry.create("swing", {}, LIMITS), 1, angle=-0.1) == [-0.42]
    assert commands(registry.create("swing", {}, LIMITS), 1, angle=0.1) == [0.42]


@pytest.mark.parametrize(("amplitude", "tick"), [(0.02, 0.05), (1.4, 0.01)])
def test_it_starts_from_rest_and_beats_within_seconds(amplitude: float, tick: float) -> None:
    rig = Rig(f"amplitude_limit={amplitude}", f"tick={tick}", *IMPERFECT).start("swing")
    rig.run_for(5)
    assert 0.6 < rig.run(1)[-1].frequency < 3.0


@pytest.mark.parametrize("C", [0.0, 0.6, 1.0])
def test_it_never_stalls_whatever_the_offset(C: float) -> None:
    rig = Rig("amplitude_limit=0.03", "simulation.noise=2e-3", "simulation.offset_y=0.2")
    rig.start("hold")
    rig.run_for(1)
    rig.start("swing", C=C)
    angles = [tick.phi_c for tick in rig.run_for(60)]
    turns = reversals(angles)
    assert max(b - a for a, b in pairwise(turns)) <= 20  # ticks of 50 ms: the default, 1 s


def test_it_swims_on_when_the_offset_jumps() -> None:
    rig = Rig().start("swing")
    rig.run_for(10)
    rig.fish._imperfections._settings = load(None, ["simulation.offset_y=0.5"]).simulation
    rig.run_for(20)
    assert rig.run(1)[-1].frequency == pytest.approx(1.67, abs=0.1)


def relative_thrust(ratio: float, seed: int) -> float:
    limit = f"amplitude_limit={ratio * SERVO_SPEED_OVER_OMEGA0}"
    config = load(None, [limit, *IMPERFECT, f"simulation.seed={seed}"])
    return simulate(config, "swing", {"C": 0.6}, 25.0).relative_thrust


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ratio", "least"),
    [(0.1, 0.92), (0.25, 0.95), (0.5, 0.95), (DEFAULT_RATIO, 0.97), (1.5, 0.95), (3.0, 0.92)],
)
def test_on_an_imperfect_rig_it_gets_most_of_the_best_thrust(ratio: float, least: float) -> None:
    """ratio: ω₀Φ/Ω; the median over five seeds of noise and drift."""
    assert statistics.median(relative_thrust(ratio, seed) for seed in range(5)) >= least


@pytest.mark.slow
@pytest.mark.parametrize("change", ["omega0=5", "omega0=25", "xi=2.4", "coupling=1"])
def test_fishes_that_have_little_in_common_swim_with_the_same_settings(change: str) -> None:
    assert simulate(load(None, [f"plant.{change}"]), "swing", {"C": 0.6}).relative_thrust > 0.9
