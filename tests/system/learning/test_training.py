import pickle
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from msgspec.structs import replace
from rigs.policy_files import vector
from rigs.processes import Subscriber, running, sets
from rigs.swimming import BRIEF, NOISY, Failing, Losing, Resting, brief_job, rows
from stable_baselines3.common.save_util import load_from_zip_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from fishd.core.errors import ConfigError
from fishd.learning.env.environment import features, thrust_scale
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.links.simulated_link import SimulatedLink
from fishd.learning.run_folder import checkpoints, runs
from fishd.learning.run_folder.checkpoints import CheckpointError
from fishd.learning.settings import EnvironmentSettings, EvaluationSettings, PpoSettings
from fishd.learning.train.jobs import Job, Outcome
from fishd.learning.train.progress import Display
from fishd.learning.train.training import FIRST_UPDATES, Training, train


@dataclass
class Witness(Display):
    """A display that stores the evaluations and counts the steps of a training."""

    evaluations: list[Evaluation] = field(default_factory=list)
    steps: int = 0

    def step(self, tank_time: float) -> None:
        self.steps += 1

    def evaluated(self, evaluation: Evaluation) -> None:
        self.evaluations.append(evaluation)

    def after(self, steps: int) -> bool:
        return self.steps >= steps


def parameters(checkpoint: Path) -> dict[str, Any]:
    return checkpoints.load_policy(checkpoint)[0].state_dict()


def same(left: dict[str, Any], right: dict[str, Any]) -> bool:
    return all(bool((left[name] == right[name]).all()) for name in left)


@pytest.mark.parametrize("dwell", [False, True])
def test_a_policy_swims_after_1000_steps(tmp_path: Path, by_force: Outcome, dwell: bool) -> None:
    outcome = by_force
    if not dwell:
        config, settings = runs.read(by_force.folder)
        free = replace(settings, environment=EnvironmentSettings(dwell=False))
        outcome = train(Job(config=config, settings=free, folder=tmp_path / "run"))
    assert (outcome.ended, outcome.steps) == ("finished", 1024)
    assert outcome.best_evaluation.relative_thrust > 0.9
    untrained = rows(outcome.folder / "progress.csv")[0]
    # With the shortest dwell, random motion swims rather well.
    better = 1.2 if dwell else 3.0
    assert outcome.best_evaluation.thrust > better * float(untrained["thrust"])


def test_the_same_seed_gives_the_same_numbers(tmp_path: Path, brief: tuple[Job, Outcome]) -> None:
    others = [train(brief_job(tmp_path / str(seed), seed=seed)).folder for seed in (0, 1)]
    runs = [brief[0].folder, *others]
    for table in ("progress.csv", "evaluations.csv"):
        a, b, c = [(run / table).read_bytes() for run in runs]
        assert a == b
        assert a != c


@pytest.fixture(scope="module")
def brief(tmp_path_factory: pytest.TempPathFactory) -> tuple[Job, Outcome]:
    """A finished training of 128 steps; its folder must not be changed."""
    job = brief_job(tmp_path_factory.mktemp("brief") / "first")
    return job, train(job)


@pytest.fixture
def copied(brief: tuple[Job, Outcome], tmp_path: Path) -> Job:
    """A copy of the finished training, which may be changed."""
    return replace(brief[0], folder=Path(shutil.copytree(brief[0].folder, tmp_path / "run")))


def resumed(job: Job, steps: int) -> Job:
    return replace(job, resume=True, settings=replace(job.settings, steps=steps))


def test_a_run_folder_contains_settings_and_progress(brief: tuple[Job, Outcome]) -> None:
    job, outcome = brief
    assert runs.read(job.folder) == (job.config, job.settings)
    table = rows(job.folder / "progress.csv")
    assert [row["steps"] for row in table] == ["64", "128"]
    assert all(float(row["tank_time"]) > 0.0 for row in table)
    assert all(value for row in table for value in row.values())
    assert [row["steps"] for row in rows(job.folder / "evaluations.csv")] == ["0", "64", "128"]
    assert list((job.folder / "tensorboard").glob("events.out.tfevents.*"))
    assert outcome.checkpoint == job.folder / "step-000128"
    assert outcome.tank_time == pytest.approx(float(table[-1]["tank_time"]))
    assert pickle.loads(pickle.dumps(brief)) == brief  # since they are sent to other processes


def test_a_checkpoint_contains_what_is_needed_to_run_the_policy(brief: tuple[Job, Outcome]) -> None:
    job, outcome = brief
    card = checkpoints.read_card(outcome.checkpoint)
    assert card.observation == features(job.config, job.settings.environment)
    assert (card.tick, card.amplitude) == (0.05, 0.42)
    past = card.provenance
    assert (past.on, past.steps, past.seed, past.algorithm) == ("simulation", 128, 0, "PPO")
    assert past.plant["omega0"] == 12.5
    assert past.settings["ppo"]["n_steps"] == 64
    assert past.relative_thrust == outcome.latest_evaluation.relative_thrust
    assert {"torch", "stable-baselines3", "gymnasium"} <= set(past.libraries)


def test_checkpoints_are_written_when_they_are_due(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run", steps=320, checkpoint_every=150, evaluation=never())
    train(job)
    names = sorted(path.name for path in job.folder.glob("step-*"))
    assert names == ["step-000000", "step-000192", "step-000320"]


def never() -> EvaluationSettings:
    return EvaluationSettings(every=0)


def test_the_best_policy_is_stored_beside_the_newest(tmp_path: Path) -> None:
    witness = Witness()
    job = brief_job(tmp_path / "run", steps=448)
    outcome = train(job, witness)
    swimming = [e for e in witness.evaluations if not e.is_stalled]
    assert outcome.best_evaluation == max(swimming, key=lambda e: (e.relative_thrust, e.steps))
    assert outcome.best == job.folder / f"best-{outcome.best_evaluation.steps:06d}"
    card = checkpoints.read_card(outcome.best)
    assert card.provenance.relative_thrust == outcome.best_evaluation.relative_thrust
    assert len(list(job.folder.glob("best-*"))) == 1


@pytest.mark.parametrize(
    ("merits", "ends_after"),
    [
        ((0.98, 0.98, 0.98, 0.98), 4),
        ((0.98, 0.98, 0.98, 0.982, 0.98, 0.982, 0.982), 7),
        ((0.98, 0.9806, 0.9811, 0.9811, 0.9811, 0.9811), 6),
        ((0.99, 0.9, 0.9, 0.9, 0.99), 5),
        ((0.96,) * 9, None),
    ],
    ids=["no better one", "a better one", "little by little", "a lost one", "poor ones"],
)
def test_a_training_has_converged_where_a_good_policy_was_not_improved_for_long_enough(
    tmp_path: Path, merits: tuple[float, ...], ends_after: int | None
) -> None:
    evaluation = EvaluationSettings(patience=3)
    job = brief_job(tmp_path / "run", evaluation=evaluation)
    recorder = Training(job, SimulatedLink(job.config), Display(), lambda: False)._recorder
    converged = []
    for merit in merits:
        figures = {"thrust": 0.02, "frequency": 1.7, "fullness": 1.0, "is_stalled": False}
        recorder.add(Evaluation(relative_thrust=merit, **figures))
        converged.append(recorder.has_converged)
    recorder.close()
    assert converged == [number == ends_after for number in range(1, len(merits) + 1)]


def test_a_training_that_has_converged_ends_before_its_last_step(tmp_path: Path) -> None:
    evaluation = EvaluationSettings(every=1, patience=2, seconds=6.0, settle=2.0)
    job = brief_job(tmp_path / "run", steps=6400, ppo=PpoSettings(), evaluation=evaluation)
    outcome = train(job)
    assert outcome.ended == "finished"
    assert outcome.message.startswith("ended early: the last 2 evaluations have shown no better")
    assert outcome.best_evaluation.relative_thrust > 0.97
    assert outcome.steps < 3200
    assert outcome.checkpoint == job.folder / f"step-{outcome.steps:06d}"
    assert outcome.best == job.folder / f"best-{outcome.best_evaluation.steps:06d}"
    again = train(resumed(job, 6400))
    assert again.steps >= outcome.steps + 2 * 64


def test_the_learning_curve_begins_at_step_zero_and_has_a_point_for_each_early_update(
    tmp_path: Path,
) -> None:
    quick = replace(BRIEF.ppo, n_epochs=1)
    evaluation = replace(BRIEF.evaluation, every=6, seconds=2.0, settle=1.0)
    witness = Witness()
    job = brief_job(tmp_path / "run", steps=64 * 26, ppo=quick, evaluation=evaluation)
    train(job, witness)
    updates = [*range(FIRST_UPDATES + 1), 18, 24, 26]
    assert [e.steps for e in witness.evaluations] == [64 * update for update in updates]
    board = EventAccumulator(str(job.folder / "tensorboard")).Reload()
    curve = board.Scalars("evaluation/relative_thrust")
    assert [point.step for point in curve] == [64 * update for update in range(27)]
    assert curve[0].value == pytest.approx(witness.evaluations[0].relative_thrust)


def test_early_evaluations_do_not_end_a_training_earlier(tmp_path: Path) -> None:
    evaluation = EvaluationSettings(every=4, patience=2)
    job = brief_job(tmp_path / "run", evaluation=evaluation)
    recorder = Training(job, SimulatedLink(job.config), Display(), lambda: False)._recorder
    good = Evaluation(
        thrust=0.02, relative_thrust=0.99, frequency=1.7, fullness=1.0, is_stalled=False
    )
    for update in range(1, 13):
        recorder.rollouts = update
        recorder.add(good)
        assert recorder.has_converged == (update >= 8)
    recorder.close()


def test_the_best_policy_may_be_the_one_that_a_training_began_with(
    tmp_path: Path, by_force: Outcome
) -> None:
    spoiling = replace(BRIEF.ppo, learning_rate=1.0, final_learning_rate=1.0)
    parent = by_force.best
    outcome = train(brief_job(tmp_path / "run", steps=64, ppo=spoiling, parent=parent))
    assert outcome.best == tmp_path / "run" / "best-000000"
    assert same(parameters(outcome.best), parameters(parent))


def test_a_training_that_was_killed_before_its_first_update_is_resumed_with_one_row_for_step_zero(
    tmp_path: Path,
) -> None:
    class Killed(Display):
        def step(self, tank_time: float) -> None:
            raise KeyboardInterrupt

    job = brief_job(tmp_path / "run", steps=64)
    with pytest.raises(KeyboardInterrupt):
        train(job, Killed())
    assert [row["steps"] for row in rows(job.folder / "evaluations.csv")] == ["0"]
    train(replace(job, resume=True))
    assert [row["steps"] for row in rows(job.folder / "evaluations.csv")] == ["0", "64"]


def test_a_resumed_run_continues_where_it_ended(copied: Job, brief: tuple[Job, Outcome]) -> None:
    job, first = copied, brief[1]
    more = resumed(job, 256)
    training = Training(more, Resting(more), Display(), lambda: False)
    model = training._model
    assert same(model.policy.state_dict(), parameters(first.checkpoint))
    updates = BRIEF.ppo.n_epochs * 2 * (64 // BRIEF.ppo.batch_size)
    moments = model.policy.optimizer.state_dict()["state"]
    assert {int(moment["step"]) for moment in moments.values()} == {updates}
    outcome = training.run()
    table = rows(job.folder / "progress.csv")
    assert [row["steps"] for row in table] == ["64", "128", "192", "256"]
    assert outcome.tank_time > first.tank_time + 6.4
    rates = [float(row["learning_rate"]) for row in table]
    np.testing.assert_allclose(np.diff(rates), -2.7e-3 * 64 / 10_000)
    assert runs.read(job.folder)[1].steps == 256


def test_a_resumed_run_does_not_repeat_its_random_numbers(tmp_path: Path) -> None:
    frozen = PpoSettings(n_steps=64, n_epochs=1, learning_rate=1e-9, final_learning_rate=1e-9)
    job = brief_job(tmp_path / "run", ppo=frozen, steps=64, evaluation=never())
    train(job)
    train(resumed(job, 128))
    first, second = rows(job.folder / "progress.csv")
    assert float(first["fullness"]) != pytest.approx(float(second["fullness"]), abs=1e-4)


def test_a_resume_continues_from_the_newest_complete_checkpoint(copied: Job) -> None:
    job = copied
    half = job.folder / ".step-000192.part"  # left by a kill during a write
    half.mkdir()
    (half / "model.zip").write_bytes(b"PK")
    with (job.folder / "progress.csv").open("a", encoding="utf-8") as file:
        file.write("192,9.6,0.1\n")
    train(resumed(job, 192))
    assert [row["steps"] for row in rows(job.folder / "progress.csv")] == ["64", "128", "192"]
    assert not half.exists()


def test_a_run_killed_in_its_first_rollout_resumes_as_if_it_was_not_killed(tmp_path: Path) -> None:
    job, whole = brief_job(tmp_path / "run"), brief_job(tmp_path / "whole")

    def die() -> bool:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(job, stop=die)
    (left,) = job.folder.glob("step-*")
    assert left.name == "step-000000"
    train(replace(job, resume=True))
    train(whole)
    table = (job.folder / "progress.csv").read_bytes()
    assert table == (whole.folder / "progress.csv").read_bytes()


def test_a_resume_of_a_finished_or_empty_run_is_refused(copied: Job, tmp_path: Path) -> None:
    job = copied
    with pytest.raises(ConfigError, match="is finished, with 128 steps; to train it for longer"):
        train(replace(job, resume=True))
    with pytest.raises(CheckpointError, match="it contains no checkpoint"):
        train(replace(job, resume=True, folder=tmp_path))


def test_a_new_run_never_overwrites_another(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    job.folder.mkdir()
    (job.folder / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(ConfigError, match="the folder is not empty"):
        train(job)


def test_a_stopped_training_keeps_what_it_has_learned(tmp_path: Path) -> None:
    witness = Witness()
    job = brief_job(tmp_path / "run", steps=10_000)
    outcome = train(job, witness, lambda: witness.after(64 + 20))
    assert (outcome.ended, outcome.steps, witness.steps) == ("interrupted", 64, 84)
    assert outcome.dropped == 20
    assert outcome.checkpoint == job.folder / "step-000064"
    assert outcome.tank_time >= 84 * 0.05
    saved, _, _ = load_from_zip_file(outcome.checkpoint / "model.zip")
    assert saved["num_timesteps"] == 64
    again = train(resumed(job, 128))
    assert (again.ended, again.steps) == ("finished", 128)


def test_a_fish_that_is_lost_ends_the_run_with_a_checkpoint_and_the_reason(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    link = Failing(job, 100)
    outcome = Training(job, link, Display(), lambda: False).run()
    assert (outcome.ended, outcome.steps) == ("lost", 64)
    assert outcome.message == "fishd is in mode fault: the newest force sample is 150 ms old"
    assert outcome.checkpoint == job.folder / "step-000064"
    assert link.closed == 1
    assert train(replace(job, resume=True)).ended == "finished"


def test_a_pause_is_never_part_of_a_transition(tmp_path: Path) -> None:
    environment = EnvironmentSettings(held_cost=0.0)  # so that only the thrust is rewarded
    as_measured = replace(BRIEF.ppo, clean_rewards=False)
    job = brief_job(tmp_path / "run", steps=192, environment=environment, ppo=as_measured)
    link = Resting(job)
    training = Training(job, link, Display(), lambda: False)
    training.run()
    inputs = features(job.config, job.settings.environment)
    environment = job.settings.environment
    per_newton = environment.reward_scale / thrust_scale(job.config, environment)
    buffer = training._model.rollout_buffer
    before, after = link.shown[-65:-1], link.shown[-64:]
    assert before[0].instruction_angle == 0.0
    assert after[0].time - before[0].time == pytest.approx(0.05)
    seen = np.array([vector(inputs, observation) for observation in before])
    np.testing.assert_array_equal(buffer.observations.reshape(64, -1), seen)
    rewards = np.array([per_newton * observation.fx for observation in after], np.float32)
    np.testing.assert_array_equal(buffer.rewards.flatten(), rewards)
    paused = [float(row["paused"]) for row in rows(job.folder / "progress.csv")]
    assert paused == pytest.approx([0.0, 3.0, 3.0])


def test_a_rollout_equals_one_that_stable_baselines_computes_step_by_step(tmp_path: Path) -> None:
    environment = EnvironmentSettings(episode=25)
    job = brief_job(tmp_path / "run", environment=environment)
    training = Training(job, SimulatedLink(job.config), Display(), lambda: False)
    buffer, model, rewards = training._model.rollout_buffer, training._model, list[float]()
    buffer.signal = None  # type: ignore[attr-defined]
    with torch.no_grad():  # without biases, all even functions of odd layers are 0
        for name, parameter in model.policy.named_parameters():
            if "value_net" in name and name.endswith("bias"):
                parameter.normal_(0.0, 0.7)
    step, reset = training._env.step, training._env.reset
    ends: list[np.ndarray] = []

    def watched_step(action: np.ndarray) -> Any:
        result = step(action)
        rewards.append(result[1])
        if result[3]:
            ends.append(result[0])
        return result

    training._env.step = watched_step  # type: ignore[method-assign]
    training._rollouts.begin(reset(seed=1)[0])
    assert training._rollouts.collect()
    arrays = (buffer.observations, buffer.actions)
    seen, actions = (torch.from_numpy(array[:, 0]) for array in arrays)
    with torch.no_grad():
        values, log_probabilities, _ = model.policy.evaluate_actions(seen, actions)
        of_ends = model.policy.predict_values(torch.from_numpy(np.array(ends)))[:, 0].numpy()
    assert np.ptp(buffer.values) > 0.05
    assert buffer.values == pytest.approx(values.numpy(), abs=1e-6)
    assert buffer.log_probs[:, 0] == pytest.approx(log_probabilities.numpy(), abs=1e-6)
    assert np.flatnonzero(buffer.episode_starts).tolist() == [0, 25, 50]
    for number, end in enumerate((24, 49)):
        rewards[end] += model.gamma * float(of_ends[number])
    assert buffer.rewards[:, 0] == pytest.approx(np.array(rewards), abs=1e-6)
    assert buffer.advantages[24] == pytest.approx(buffer.rewards[24] - buffer.values[24], abs=1e-6)
    assert np.std(buffer.actions) == pytest.approx(np.exp(0.7), rel=0.3)


def test_late_actions_are_counted_and_not_learned_from(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    training = Training(job, Losing(job), Display(), lambda: False)
    outcome = training.run()
    assert outcome.ended == "finished"
    lost = [int(row["lost_ticks"]) for row in rows(job.folder / "progress.csv")]
    # Of 64 ticks, and those at the starts of episodes
    assert all(6 <= number <= 15 for number in lost)
    void = int(training._model.rollout_buffer.void.sum())  # type: ignore[attr-defined]
    assert 3 <= void <= lost[-1]


def test_an_agent_that_is_too_slow_for_the_tick_ends_with_an_explanation(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    outcome = Training(job, Losing(job, every=1), Display(), lambda: False).run()
    assert (outcome.ended, outcome.steps) == ("lost", 0)
    assert outcome.message.startswith("in most of the last 64 steps the agent's action came too")


def test_a_run_that_diverges_stores_no_broken_policy(tmp_path: Path) -> None:
    wild = PpoSettings(n_steps=64, learning_rate=1.0, final_learning_rate=1.0, max_grad_norm=100.0)
    job = brief_job(tmp_path / "run", steps=6400, ppo=wild, evaluation=never())
    training = Training(job, Resting(job), Display(), lambda: False)
    with torch.no_grad():
        training._model.policy.log_std.fill_(80.0)
    outcome = training.run()
    assert outcome.ended == "diverged"
    assert "learning diverged in the update after 64 steps; lower ppo.learning" in outcome.message
    assert outcome.checkpoint == job.folder / "step-000000"
    assert all(bool(v.isfinite().all()) for v in parameters(outcome.checkpoint).values())


def test_another_run_may_begin_with_its_nets(tmp_path: Path, brief: tuple[Job, Outcome]) -> None:
    parent = brief[1].checkpoint
    job = brief_job(tmp_path / "second", parent=parent, seed=5)
    training = Training(job, Resting(job), Display(), lambda: False)
    assert same(training._model.policy.state_dict(), parameters(parent))
    assert not training._model.policy.optimizer.state_dict()["state"]
    outcome = training.run()
    assert outcome.steps == 128
    note = checkpoints.read_card(outcome.checkpoint).provenance.note
    assert note == "began with first/step-000128, 128 steps in simulation"


def test_fishd_receives_the_address_of_the_agent(tmp_path: Path) -> None:
    elsewhere = f"ipc://{tmp_path}/elsewhere"
    settings = sets("lockstep=true", *NOISY)
    with running(tmp_path, *settings) as fishd, Subscriber(fishd.telemetry, b"event") as events:
        events.connected()
        job = brief_job(tmp_path / "run", steps=128, evaluation=never())
        train(replace(job, on="live", endpoint=fishd.endpoint, agent=elsewhere))
        taken = events.until(kind="controller")["data"]
    assert (taken["controller"], taken["parameters"]["agent"]) == ("remote", elsewhere)


def test_a_training_stopped_before_its_start_leaves_the_fish_at_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Training, "_reset", lambda _: pytest.fail("the fish swims"))
    outcome = train(brief_job(tmp_path / "run"), stop=lambda: True)
    assert (outcome.ended, outcome.steps) == ("interrupted", 0)
