"""Agents that see several ticks, and fish with a delay, play and reaction of the servo."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from rigs.swimming import brief_job

from fishd.config import load
from fishd.controllers.policy.file import read
from fishd.core.signals import Observation
from fishd.lab.simulation import simulate
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.evaluation import evaluate_in_simulation, worst_on_others
from fishd.learning.env.fish_variation import draw_fish
from fishd.learning.export import export
from fishd.learning.links.simulated_link import SimulatedLink
from fishd.learning.run_folder.checkpoints import CheckpointError
from fishd.learning.settings import (
    EnvironmentSettings,
    EvaluationSettings,
    Randomisation,
    TrainingSettings,
)
from fishd.learning.train.training import train

CONFIG = load(None, ["simulation.noise=0.001"])
HARSH = Randomisation(
    servo_lag=0.6,
    thrust_coefficient=0.6,
    lateral_drag=2.0,
    servo_delay=0.08,
    servo_dead_zone=0.05,
    backlash=0.1,
    servo_reaction=3e-3,
    rotation=0.17,
    cable_slack=0.2,
)
SEEN = ("fy", "instruction_angle")
REMEMBERING = EnvironmentSettings(observation=SEEN, history=4, longest_start=0)


def act(env: SwimEnv, share: float) -> np.ndarray:
    return env.step(np.full(1, share, np.float32))[0]


def test_the_agent_sees_the_latest_ticks_newest_first() -> None:
    env = SwimEnv(SimulatedLink(CONFIG), CONFIG, REMEMBERING)
    first, _ = env.reset(seed=1)
    assert env.observation_space.shape == first.shape == (8,)
    assert first.reshape(4, 2).tolist() == [first[:2].tolist()] * 4
    shares = [0.25, 0.5, 1.0, 0.75, 0.125]
    for share in shares:
        seen = act(env, share)
    assert seen[1::2].tolist() == shares[:0:-1]


def test_another_episode_begins_with_another_history() -> None:
    env = SwimEnv(SimulatedLink(CONFIG), CONFIG, REMEMBERING)
    env.reset(seed=1)
    act(env, 1.0)
    first, _ = env.reset(seed=2)
    assert first[1::2].tolist() == [0.0] * 4


def test_a_file_with_a_history_swims_as_the_policy_that_was_trained(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run", environment=REMEMBERING)
    outcome = train(job)
    exported = export(outcome.checkpoint, tmp_path / "policy.onnx", force=True)
    card = read(exported.path).card
    assert (card.history, card.numbers) == (4, 8)
    seed = job.config.simulation.seed + 1  # as in the evaluation of the export
    free = replace(
        job.config,
        simulation=replace(job.config.simulation, seed=seed),
        chatter=replace(job.config.chatter, dwell=0.0),
    )
    report = simulate(free, "ppo", {"policy": str(exported.path)}, 4.0, 2.0)
    assert report.relative_thrust == pytest.approx(exported.evaluation.relative_thrust, abs=1e-3)


def test_a_training_begins_only_with_a_policy_of_the_same_history(tmp_path: Path) -> None:
    parent = train(brief_job(tmp_path / "first", environment=REMEMBERING)).checkpoint
    longer = replace(REMEMBERING, history=5)
    with pytest.raises(CheckpointError, match="its history is 4, that of this training is 5; "):
        train(brief_job(tmp_path / "second", environment=longer, parent=parent))


def test_the_rigs_of_a_randomisation_are_anywhere_in_its_range() -> None:
    fish = [draw_fish(CONFIG, HARSH, seed) for seed in range(40)]
    largest = {"servo_delay": 0.08, "servo_dead_zone": 0.05, "backlash": 0.1, "cable_slack": 0.2}
    for name, limit in largest.items():
        values = [getattr(config.plant, name) for config in fish]
        assert 0.0 < min(values) < 0.2 * limit < 0.8 * limit < max(values) < limit
    for name, limit in (("servo_lag", 1.6), ("thrust_coefficient", 1.6), ("lateral_drag", 3.0)):
        shares = [getattr(config.plant, name) / getattr(CONFIG.plant, name) for config in fish]
        assert 1.0 / limit < min(shares) < 0.9 < 1.1 < max(shares) < limit
    assert min(config.plant.servo_reaction for config in fish) < -1e-3
    assert max(config.simulation.rotation for config in fish) > 0.1


def test_another_varied_parameter_does_not_change_the_others() -> None:
    spread = Randomisation(omega0=0.2, offset=0.01)
    before = draw_fish(CONFIG, spread, 3)
    after = draw_fish(CONFIG, replace(spread, backlash=0.1), 3)
    assert after.plant == replace(before.plant, backlash=after.plant.backlash)
    assert after.simulation == before.simulation


def test_with_own_fish_a_weak_fish_gets_the_same_reward_as_a_strong_one() -> None:
    def reward(own: bool, coefficient: float) -> float:
        config = load(None, ["simulation.noise=0", f"plant.thrust_coefficient={coefficient}"])
        settings = replace(REMEMBERING, own_fish=own)
        env = SwimEnv(SimulatedLink(config), CONFIG, settings)
        env.reset(seed=1)
        return sum(float(env.step(np.full(1, (-1.0) ** (k // 6)))[1]) for k in range(60))

    assert reward(False, 5e-3) == pytest.approx(0.5 * reward(False, 10e-3), rel=1e-3)
    assert reward(True, 5e-3) == pytest.approx(reward(True, 10e-3), rel=1e-3)


def test_a_policy_that_violates_the_shortest_dwell_has_no_worst_thrust_in_the_range() -> None:
    def six_ticks(seen: Observation, stack: object) -> float:
        return 0.42 * (-1.0) ** (round(seen.time / 0.05) // 6)

    def every_tick(seen: Observation, stack: object) -> float:
        return 0.42 * (-1.0) ** round(seen.time / 0.05)

    chosen = EvaluationSettings(seconds=8.0, settle=3.0, others=3, others_from="range")
    settings = TrainingSettings(randomisation=Randomisation(backlash=0.1), evaluation=chosen)
    assert evaluate_in_simulation(CONFIG, six_ticks, chosen).relative_thrust > 0.9
    assert worst_on_others(CONFIG, six_ticks, settings) > 0.7
    assert worst_on_others(CONFIG, every_tick, settings) == 0.0


def test_with_own_fish_reversals_are_delayed_by_its_own_shortest_dwell() -> None:
    def reversals(own: bool) -> int:
        late = load(None, ["plant.servo_delay=0.08"])  # its dwell is 0.25 s
        env = SwimEnv(SimulatedLink(late), CONFIG, replace(REMEMBERING, own_fish=own))
        env.reset(seed=1)
        sides = [act(env, -np.sign(env.latest.instruction_angle) or 1.0)[1] for _ in range(41)]
        return int(np.count_nonzero(np.diff(np.sign(sides))))

    assert (reversals(False), reversals(True)) == (10, 8)
