from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the extra 'learn' is not installed")
pytest.importorskip("stable_baselines3", reason="the extra 'learn' is not installed")
pytest.importorskip("tensorboard", reason="the extra 'learn' is not installed")

from msgspec.structs import replace
from stable_baselines3.common.save_util import load_from_zip_file
from swimming import BRIEF, Failing, Losing, Resting, brief_job, rows

from fishd.errors import ConfigError
from fishd.learning import checkpoints, runs
from fishd.learning.checkpoints import CheckpointError, Evaluation
from fishd.learning.jobs import Job
from fishd.learning.progress import Quiet
from fishd.learning.scales import features, thrust_scale
from fishd.learning.settings import EvaluationSettings, PpoSettings, TrainingSettings
from fishd.learning.training import Training, train
from fishd.policies.card import Layout


@dataclass
class Witness(Quiet):
    """Is told how a training goes on, and remembers."""

    evaluations: list[Evaluation] = field(default_factory=list)
    steps: int = 0

    def step(self, tank_time: float) -> None:
        self.steps += 1

    def evaluated(self, evaluation: Evaluation, best: bool) -> None:
        self.evaluations.append(evaluation)

    def after(self, steps: int) -> bool:
        return self.steps >= steps


def parameters(checkpoint: Path) -> dict[str, Any]:
    return checkpoints.load_policy(checkpoint).state_dict()


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    return all(bool((one[name] == other[name]).all()) for name in one)


def test_a_thousand_steps_teach_it_to_swim(tmp_path: Path) -> None:
    settings = TrainingSettings(evaluation=EvaluationSettings(seconds=10.0, settle=5.0))
    job = replace(brief_job(tmp_path / "run"), settings=replace(settings, steps=1024))
    outcome = train(job)
    assert (outcome.ended, outcome.steps) == ("finished", 1024)
    assert outcome.best_evaluation
    assert outcome.best_evaluation.efficiency > 0.9
    untrained = rows(job.folder / "progress.csv")[0]
    assert outcome.best_evaluation.thrust > 3.0 * float(untrained["thrust"])


def test_the_same_seed_gives_the_same_numbers_and_another_does_not(tmp_path: Path) -> None:
    runs = [train(brief_job(tmp_path / name)).folder for name in ("a", "b")]
    runs.append(train(brief_job(tmp_path / "c", seed=1)).folder)
    for table in ("progress.csv", "evaluations.csv"):
        a, b, c = [(run / table).read_bytes() for run in runs]
        assert a == b
        assert a != c


def test_a_run_folder_says_what_was_trained_and_how_it_went(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    outcome = train(job)
    assert runs.read(job.folder) == (job.config, job.settings)
    table = rows(job.folder / "progress.csv")
    assert [row["steps"] for row in table] == ["64", "128"]
    assert all(float(row["tank_time"]) > 0.0 for row in table)
    assert all(value for row in table for value in row.values())
    assert [row["steps"] for row in rows(job.folder / "evaluations.csv")] == ["64", "128"]
    assert list((job.folder / "tensorboard").glob("events.out.tfevents.*"))
    assert outcome.checkpoint == job.folder / "step-000128"
    assert outcome.tank_time == pytest.approx(float(table[-1]["tank_time"]))


def test_a_checkpoint_says_what_must_be_known_to_run_the_policy(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    outcome = train(job)
    assert outcome.checkpoint
    card = checkpoints.read_card(outcome.checkpoint)
    assert card.observation == features(job.config, job.settings.environment)
    assert (card.tick, card.amplitude) == (0.05, 0.42)
    past = card.provenance
    assert (past.on, past.steps, past.seed, past.algorithm) == ("simulation", 128, 0, "PPO")
    assert past.plant["omega0"] == 12.5
    assert past.settings["ppo"]["n_steps"] == 64
    assert outcome.latest_evaluation
    assert past.efficiency == outcome.latest_evaluation.efficiency
    assert {"torch", "stable-baselines3", "gymnasium"} <= set(past.libraries)


def test_checkpoints_come_when_they_are_due(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run", steps=320, checkpoint_every=150, evaluation=never())
    train(job)
    found = sorted(path.name for path in job.folder.glob("step-*"))
    assert found == ["step-000000", "step-000192", "step-000320"]


def never() -> EvaluationSettings:
    return EvaluationSettings(every=0)


def test_the_best_policy_is_kept_beside_the_newest(tmp_path: Path) -> None:
    witness = Witness()
    job = brief_job(tmp_path / "run", steps=1024)
    outcome = train(job, witness)
    swimming = [e for e in witness.evaluations if not e.stalled]
    assert outcome.best_evaluation == max(swimming, key=lambda e: (e.efficiency, e.steps))
    assert outcome.best == job.folder / f"best-{outcome.best_evaluation.steps:06d}"
    assert checkpoints.read_card(outcome.best).provenance.efficiency == (
        outcome.best_evaluation.efficiency
    )
    assert len(list(job.folder.glob("best-*"))) == 1


def test_a_policy_that_holds_still_is_marked_and_never_the_best(tmp_path: Path) -> None:
    timid = PpoSettings(n_steps=64, n_epochs=1, learning_rate=1e-9, final_learning_rate=1e-9)
    job = brief_job(tmp_path / "run", ppo=timid)  # learns nothing to speak of
    outcome = train(job)
    assert [row["stalled"] for row in rows(job.folder / "evaluations.csv")] == ["1", "1"]
    assert outcome.best is None


def test_a_resumed_run_goes_on_exactly_where_it_was(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    first = train(job)
    assert first.checkpoint
    more = replace(job, resume=True, settings=replace(job.settings, steps=256))
    training = Training(more, Resting(more), Quiet(), lambda: False)
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
    train(replace(job, resume=True, settings=replace(job.settings, steps=128)))
    first, second = rows(job.folder / "progress.csv")
    assert float(first["fullness"]) != pytest.approx(float(second["fullness"]), abs=1e-4)


def test_a_resume_goes_on_from_the_newest_whole_checkpoint(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    train(job)
    half = job.folder / ".step-000192.part"  # what a kill while one is written leaves
    half.mkdir()
    (half / "model.zip").write_bytes(b"PK")
    with (job.folder / "progress.csv").open("a", encoding="utf-8") as file:
        file.write("192,9.6,0.1\n")
    train(replace(job, resume=True, settings=replace(job.settings, steps=192)))
    assert [row["steps"] for row in rows(job.folder / "progress.csv")] == ["64", "128", "192"]
    assert not half.exists()


def test_a_run_that_was_killed_in_its_first_rollout_goes_on_as_if_it_had_not_been(
    tmp_path: Path,
) -> None:
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


def test_a_run_that_has_all_its_steps_or_no_checkpoint_says_so(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    train(job)
    with pytest.raises(ConfigError, match="is finished, with 128 steps; to train it for longer"):
        train(replace(job, resume=True))
    with pytest.raises(CheckpointError, match="no checkpoint is in there"):
        train(replace(job, resume=True, folder=tmp_path))


def test_a_new_run_never_overwrites_another(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    job.folder.mkdir()
    (job.folder / "notes.txt").write_text("mine", encoding="utf-8")
    with pytest.raises(ConfigError, match="is there already; give another --folder"):
        train(job)


def test_when_told_to_stop_it_keeps_what_it_has_learned(tmp_path: Path) -> None:
    witness = Witness()
    job = brief_job(tmp_path / "run", steps=10_000)
    outcome = train(job, witness, lambda: witness.after(64 + 20))
    assert (outcome.ended, outcome.steps, witness.steps) == ("interrupted", 64, 84)
    assert outcome.dropped == 20
    assert outcome.checkpoint == job.folder / "step-000064"
    assert outcome.tank_time >= 84 * 0.05
    saved, _, _ = load_from_zip_file(outcome.checkpoint / "model.zip")
    assert saved
    assert saved["num_timesteps"] == 64
    again = train(replace(job, resume=True, settings=replace(job.settings, steps=128)))
    assert (again.ended, again.steps) == ("finished", 128)


def test_a_fish_that_is_lost_ends_the_run_with_a_checkpoint_and_the_reason(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    link = Failing(job, 100)
    outcome = Training(job, link, Quiet(), lambda: False).run()
    assert (outcome.ended, outcome.steps) == ("lost", 64)
    assert outcome.message == "fishd is in mode fault: the newest force sample is 150 ms old"
    assert outcome.checkpoint == job.folder / "step-000064"
    assert link.closed == 1
    assert train(replace(job, resume=True)).ended == "finished"


def test_a_pause_never_gets_into_a_transition(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run", steps=192)
    link = Resting(job)
    training = Training(job, link, Quiet(), lambda: False)
    training.run()
    layout = Layout(features(job.config, job.settings.environment))
    per_newton = job.settings.environment.reward_scale / thrust_scale(
        job.config, job.settings.environment
    )
    buffer = training._model.rollout_buffer
    before, after = link.shown[-65:-1], link.shown[-64:]
    assert before[0].instruction_angle == 0.0
    assert after[0].time - before[0].time == pytest.approx(0.05)
    seen = np.array([layout.vector(observation) for observation in before])
    np.testing.assert_array_equal(buffer.observations.reshape(64, -1), seen)
    rewards = np.array([per_newton * observation.fx for observation in after], np.float32)
    np.testing.assert_array_equal(buffer.rewards.flatten(), rewards)
    paused = [float(row["paused"]) for row in rows(job.folder / "progress.csv")]
    assert paused == pytest.approx([0.0, 3.0, 3.0])


def test_actions_that_came_too_late_are_counted_and_teach_nothing(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    training = Training(job, Losing(job), Quiet(), lambda: False)
    outcome = training.run()
    assert outcome.ended == "finished"
    lost = [int(row["lost"]) for row in rows(job.folder / "progress.csv")]
    assert all(6 <= number <= 15 for number in lost)  # of 64 ticks, and those of fresh starts
    void = int(training._model.rollout_buffer.void.sum())  # type: ignore[attr-defined]
    assert 3 <= void <= lost[-1]


def test_an_agent_that_is_too_slow_for_the_tick_learns_nothing_and_says_so(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run")
    outcome = Training(job, Losing(job, every=1), Quiet(), lambda: False).run()
    assert (outcome.ended, outcome.steps) == ("lost", 0)
    assert outcome.message.startswith("in most of the last 64 steps the agent's action came too")


def test_a_run_that_blows_up_says_so_and_keeps_no_broken_policy(tmp_path: Path) -> None:
    wild = PpoSettings(n_steps=64, learning_rate=1.0, final_learning_rate=1.0, max_grad_norm=100.0)
    job = brief_job(tmp_path / "run", steps=6400, ppo=wild, evaluation=never())
    training = Training(job, Resting(job), Quiet(), lambda: False)
    with torch.no_grad():
        training._model.policy.log_std.fill_(80.0)
    outcome = training.run()
    assert outcome.ended == "diverged"
    assert "learning blew up in the update after 64 steps; lower ppo.learning" in outcome.message
    assert outcome.checkpoint == job.folder / "step-000000"
    assert all(bool(v.isfinite().all()) for v in parameters(outcome.checkpoint).values())


def test_another_run_can_begin_with_its_networks(tmp_path: Path) -> None:
    first = train(brief_job(tmp_path / "first"))
    assert first.checkpoint
    job = brief_job(tmp_path / "second", parent=first.checkpoint, seed=5)
    training = Training(job, Resting(job), Quiet(), lambda: False)
    assert same(training._model.policy.state_dict(), parameters(first.checkpoint))
    assert not training._model.policy.optimizer.state_dict()["state"]
    outcome = training.run()
    assert outcome.steps == 128
    assert outcome.checkpoint
    note = checkpoints.read_card(outcome.checkpoint).provenance.note
    assert note == "began with first/step-000128, 128 steps in simulation"


def test_networks_with_other_scales_or_sizes_are_refused(tmp_path: Path) -> None:
    first = train(brief_job(tmp_path / "first"))
    job = brief_job(tmp_path / "second", parent=first.checkpoint)
    with pytest.raises(CheckpointError, match="its observation, with scales, differs"):
        train(replace(job, config=replace(job.config, amplitude_limit=0.3)))
    narrow = replace(job.settings, ppo=replace(job.settings.ppo, hidden=(8,)))
    with pytest.raises(
        CheckpointError, match=r"its ppo\.hidden is \[64, 64\], that of this training is \[8\]"
    ):
        train(replace(job, settings=narrow))
    assert not job.folder.exists()


def test_a_job_can_be_sent_to_another_process(tmp_path: Path) -> None:
    import pickle

    job = brief_job(tmp_path / "run")
    assert isinstance(pickle.loads(pickle.dumps(job)), Job)
    outcome = train(job)
    assert pickle.loads(pickle.dumps(outcome)) == outcome
