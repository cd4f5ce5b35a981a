"""The removal of the errors of a force sensor from the thrust that a policy learns from."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray
from rigs.swimming import BRIEF, brief_job

from fishd.config import load
from fishd.learning.env.environment import SwimEnv
from fishd.learning.links.simulated_link import SimulatedLink
from fishd.learning.settings import EnvironmentSettings, Randomisation
from fishd.learning.thrust_signal import ThrustSignal
from fishd.learning.train.progress import Display
from fishd.learning.train.training import Training, train

Forces = NDArray[np.float64]
TURNED, CLEAN = "simulation.rotation=0.175", "simulation.noise=0"


def swum(*overrides: str) -> tuple[Forces, Forces, float]:
    """Return F_x and F_y of a fish with half beats of five to seven ticks, and the best thrust."""
    config = load(None, [CLEAN, *overrides])
    env = SwimEnv(SimulatedLink(config), config, EnvironmentSettings(longest_start=0, dwell=False))
    env.reset(seed=0)
    halves, draw, forces, side = [], np.random.default_rng(0), [], 1.0
    while len(halves) < 120:
        halves.append(int(draw.integers(5, 8)))
        for _ in range(halves[-1]):
            info = env.step(np.full(1, side, np.float32))[4]
            forces.append((info["thrust"], info["lateral_force"]))
        side = -side
    fx, fy = np.array(forces).T
    return fx, fy, env.best_thrust


def cleaned(fx: Forces, fy: Forces, best: float) -> Forces:
    """Return the thrust from rollouts of 64 ticks, for the second half of them."""
    signal = ThrustSignal(best)
    parts = [signal.estimate(fx[k : k + 64], fy[k : k + 64]) for k in range(0, len(fx) - 63, 64)]
    return np.concatenate(parts[len(parts) // 2 :])


def error(*overrides: str) -> float:
    """Return the rms error of the thrust with an imperfection, over the best thrust."""
    good, bad = swum(), swum(*overrides)
    return float(np.std(cleaned(*bad) - cleaned(*good))) / good[2]


def test_with_a_good_sensor_only_the_mean_is_removed() -> None:
    fx, fy, best = swum()
    thrust = ThrustSignal(best).estimate(fx[:64], fy[:64])
    assert thrust.mean() == pytest.approx(0.0, abs=1e-12)
    assert np.std(thrust - fx[:64]) < 0.2 * best


def test_the_share_of_the_lateral_force_in_a_turned_sensor_is_removed() -> None:
    fx, _, best = swum(TURNED)
    true, _, _ = swum()
    assert np.std(fx - true) > best
    assert error(TURNED) < 0.1


def test_an_offset_and_its_drift_are_removed() -> None:
    assert error("simulation.offset_x=0.1", "simulation.drift=0.02") < 0.15


def test_a_spike_counts_no_more_than_a_very_good_tick() -> None:
    fx, fy, best = swum()
    fx[20] += 40.0 * best
    thrust = ThrustSignal(best).estimate(fx[:64], fy[:64])
    assert thrust.max() < 6.0 * best


def test_a_rollout_without_a_single_valid_step_is_no_error() -> None:
    assert ThrustSignal(0.02).estimate(np.zeros(0), np.zeros(0)).shape == (0,)
    assert ThrustSignal(0.02).estimate(np.full(8, 0.3), np.zeros(8)).tolist() == [0.0] * 8


def test_the_limit_of_a_spike_does_not_depend_on_the_scale_of_the_reward(tmp_path: Path) -> None:
    largest = []
    for scale in (None, 0.5):
        environment = replace(BRIEF.environment, thrust_scale=scale)
        job = brief_job(tmp_path / f"run-{scale}", environment=environment)
        training = Training(job, SimulatedLink(job.config), Display(), lambda: False)
        training._recorder.close()
        rollout = training._model.rollout_buffer
        fx = np.linspace(-0.001, 0.001, 64)
        fx[20] = 1.0
        largest.append(rollout.signal.estimate(fx, np.zeros(64)).max())
    assert largest[0] == largest[1] < 0.01


def test_the_errors_are_removed_unless_each_episode_has_another_fish(tmp_path: Path) -> None:
    def signal(name: str, **changes: object) -> ThrustSignal | None:
        job = brief_job(tmp_path / name, **changes)
        training = Training(job, SimulatedLink(job.config), Display(), lambda: False)
        training._recorder.close()
        rollout = training._model.rollout_buffer
        return rollout.signal

    assert signal("default")
    assert signal("off", ppo=replace(BRIEF.ppo, clean_rewards=False)) is None
    assert signal("others", randomisation=Randomisation(omega0=0.2)) is None


def test_a_policy_learns_to_swim_a_rig_whose_sensor_is_turned_and_drifts(tmp_path: Path) -> None:
    rig = ("simulation.noise=0.002", TURNED, "simulation.offset_x=0.02", "simulation.drift=0.01")
    job = brief_job(tmp_path / "run", steps=1152)
    settings = replace(job.settings, ppo=type(BRIEF.ppo)())
    often = replace(settings.evaluation, every=6)
    job = replace(job, config=load(None, rig), settings=replace(settings, evaluation=often))
    best = train(job).best_evaluation
    assert best.relative_thrust > 0.95
