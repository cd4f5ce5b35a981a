"""Evaluations in the tank: short swims of several policies until the best one is clear."""

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
import torch
from msgspec.structs import replace
from rigs.processes import PATIENCE, running, sets
from rigs.swimming import NOISY, Failing, Resting, brief_job, rows
from stable_baselines3.common.vec_env import DummyVecEnv

from fishd.client import Fish
from fishd.config import load
from fishd.core.signals import Observation
from fishd.learning import export as exporting
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.env.swims import REST_TIME_S, Swims
from fishd.learning.links.simulated_link import SimulatedLink
from fishd.learning.ppo import make_learner
from fishd.learning.run_folder import checkpoints
from fishd.learning.settings import EnvironmentSettings, PpoSettings, TrainingSettings
from fishd.learning.train import candidates as tank_evaluations
from fishd.learning.train.candidates import TankEvaluations
from fishd.learning.train.jobs import Job
from fishd.learning.train.progress import Display
from fishd.learning.train.training import Training, train
from fishd.virtual.plant.optimum import square_wave

Policy = Callable[[Observation], float]
DRIFTS = ["offset_x=0.02", "drift_rate=0.001", "drift=0.005", "drift_walk=0.0005"]


def square(ticks: int) -> Policy:
    return lambda seen: 0.42 if round(seen.time / 0.05) // ticks % 2 else -0.42


def still(_: Observation) -> float:
    return 0.42


def chatter(seen: Observation) -> float:
    return -0.42 if round(seen.time / 0.05) % 2 else 0.42


def env_on(*settings: str) -> SwimEnv:
    config = load(None, [f"simulation.{setting}" for setting in settings])
    env = SwimEnv(SimulatedLink(config), config, EnvironmentSettings())
    env.reset(seed=1)
    return env


def swims(env: SwimEnv) -> Swims:
    return Swims(env, lambda: False)


@pytest.mark.parametrize("drift", DRIFTS)
def test_a_short_swim_measures_the_thrust_with_any_drift_of_the_sensor(drift: str) -> None:
    env = env_on(drift, "noise=0.001", "seed=3")
    measured_swims, results = swims(env), []
    for _ in range(3):
        results.append(measured_swims.swim(lambda seen, _: square(6)(seen)))
    true = square_wave(env.config.plant, 0.42, 1 / 0.6).thrust
    assert [swim.thrust for swim in results] == pytest.approx([true] * 3, rel=0.04)
    assert [swim.frequency for swim in results] == pytest.approx([1 / 0.6] * 3)
    assert env.tank_time == pytest.approx(3 * 3.5 + 4 * REST_TIME_S, abs=0.6)  # and the start


@pytest.mark.parametrize(
    "decide",
    [still, chatter, lambda _: 0.0, lambda seen: 0.2 + 0.1 * square(6)(seen)],
    ids=["holds still", "reverses in every tick", "at neutral", "stays on one side"],
)
def test_a_policy_that_does_not_swim_is_stopped_after_two_seconds(decide: Policy) -> None:
    swim = swims(env_on()).swim(lambda seen, _: decide(seen))
    assert swim.is_stalled
    assert swim.thrust is None
    assert swim.seconds <= 2.0


def test_a_slow_fish_swims_for_longer() -> None:
    config = load(None, ["plant.omega0=4"])
    env = SwimEnv(SimulatedLink(config), config, EnvironmentSettings())
    env.reset(seed=1)
    assert not swims(env).fits(7.5)
    assert swims(env_on()).fits(7.5)


class Tank:
    """Evaluations with given policies in place of those of the networks.

    The exploration of the model identifies its policy, so a policy swims only if the model has the
    parameters of its candidate.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *settings: str) -> None:
        self.env = env_on(*settings)
        self.model = make_learner(TrainingSettings(), DummyVecEnv([lambda: self.env]))
        self.policies: list[Policy] = []
        self.asked: list[int] = []
        """Indices of the policies that swam in the latest evaluation, in order."""
        self.tank = TankEvaluations(self.model, self.env, None, lambda: False)

        def decides(policy: Any, *_: object) -> Callable[..., float]:
            index = round(float(policy.log_std.item()))
            self.asked.append(index)
            return lambda seen, stack: self.policies[index](seen)

        monkeypatch.setattr(tank_evaluations, "DeterministicPolicy", decides)

    def evaluate(self, policy: Policy, seconds: float = 13.0) -> list[Evaluation]:
        """Return the evaluations with `policy` as the newest candidate."""
        index = len(self.policies)
        self.policies.append(policy)
        self.asked = []
        with torch.no_grad():
            self.model.policy.log_std.fill_(float(index))
        self.tank.add(64 * (index + 1), index + 1)
        self.tank.swim(seconds)
        assert round(float(self.model.policy.log_std.item())) == index
        return self.tank.results(64 * (index + 1))

    @property
    def best(self) -> int | None:
        return self.tank.best.steps // 64 - 1 if self.tank.best else None


@pytest.mark.parametrize("drift", DRIFTS)
@pytest.mark.parametrize("order", [(6, 5), (5, 6)])
def test_with_a_drifting_sensor_the_better_of_two_policies_is_chosen(
    monkeypatch: pytest.MonkeyPatch, drift: str, order: tuple[int, int]
) -> None:
    tank = Tank(monkeypatch, drift, "noise=0.001", "seed=5")
    for ticks in order:
        tank.evaluate(square(ticks))
    assert tank.best == order.index(6)


def test_a_policy_that_stalls_costs_little_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    tank = Tank(monkeypatch, "noise=0.001")
    before = tank.env.tank_time
    (row,) = tank.evaluate(still)
    assert (row.is_stalled, row.best, row.thrust_ci95, row.thrust) == (True, False, None, 0.0)
    assert tank.env.tank_time - before == pytest.approx(2 * REST_TIME_S + 1.5)
    tank.evaluate(square(6))
    tank.evaluate(square(6))
    assert 0 not in tank.asked
    assert tank.best in (1, 2)


def test_where_the_best_stalls_the_next_best_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    tank = Tank(monkeypatch, "noise=0.001")
    tank.evaluate(square(5))
    tank.evaluate(square(6))
    assert tank.best == 1
    tank.policies[1] = still
    results = tank.evaluate(square(6), 40.0)
    assert {row.policy: (row.is_stalled, row.best) for row in results}[128] == (True, False)
    assert tank.best != 1


def test_an_evaluation_takes_no_longer_than_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    tank = Tank(monkeypatch, "noise=0.003")
    for seconds, swims in ((8.0, 1), (13.0, 2), (20.0, 3)):
        tank.evaluate(square(6))  # so that there are several candidates
        before = tank.env.tank_time
        tank.evaluate(square(6), seconds)
        assert len(tank.asked) == swims
        assert tank.env.tank_time - before <= seconds + 1e-6


def on_robot(folder: Path, **changes: Any) -> Job:
    """Return a training with a fish in this process that is evaluated as in a tank."""
    return brief_job(folder, on="live", steps=changes.pop("steps", 192), **changes)


@pytest.fixture
def beating(monkeypatch: pytest.MonkeyPatch) -> list[Policy]:
    """Policies that swim in evaluations, in order; the last one swims repeatedly."""
    policies = [square(6)]

    def decides(*_: object) -> Callable[..., float]:
        policy = policies.pop(0) if len(policies) > 1 else policies[0]
        return lambda seen, stack: policy(seen)

    monkeypatch.setattr(tank_evaluations, "DeterministicPolicy", decides)
    return policies


class StoringTraining(Training):
    """A training that stores the networks of each candidate."""

    networks: dict[int, dict[str, torch.Tensor]]

    def _evaluate(self) -> None:
        parameters = copy.deepcopy(self._model.policy.state_dict())
        self.networks[self._recorder.steps] = parameters
        super()._evaluate()


def storing_training(job: Job, link: SimulatedLink) -> StoringTraining:
    training = StoringTraining(job, link, Display(), lambda: False)
    training.networks = {}
    return training


def same(checkpoint: Path, networks: dict[str, torch.Tensor]) -> bool:
    stored = checkpoints.load_policy(checkpoint)[0].state_dict()
    return all(bool((stored[name] == networks[name]).all()) for name in stored)


def test_the_checkpoint_has_the_networks_of_the_best_also_of_an_older_one(
    tmp_path: Path, beating: list[Policy], monkeypatch: pytest.MonkeyPatch
) -> None:
    beating[:] = [square(6), square(5), square(6), still, square(5)]
    job = on_robot(tmp_path / "run")
    training = storing_training(job, Resting(job))
    outcome = training.run()
    best = outcome.best_evaluation
    assert (best.policy, best.is_stalled, best.swim_time) == (64, False, 7.0)
    assert outcome.best == checkpoints.find(job.folder) == job.folder / "best-000064"
    assert same(outcome.best, training.networks[64])
    past = checkpoints.read_card(outcome.best).provenance
    assert (past.steps, past.relative_thrust, past.on) == (64, best.relative_thrust, "live")
    assert same(outcome.checkpoint, training.networks[192])  # the newest one has learned since
    table = rows(job.folder / "evaluations.csv")
    reported = [(row["steps"], row["policy"], row["is_stalled"], row["best"]) for row in table]
    assert reported == [
        ("64", "64", "0", "1"),
        ("128", "128", "0", "0"),
        ("128", "64", "0", "1"),
        ("192", "192", "1", "0"),
        ("192", "128", "0", "0"),
    ]
    assert [row["swim_time"] for row in table] == ["3.5", "3.5", "7.0", "1.5", "7.0"]
    assert 0.0 < float(table[2]["thrust_ci95"]) < float(table[0]["thrust_ci95"])
    monkeypatch.delattr(exporting, "evaluate_in_simulation")  # the figures are those of the tank
    exported = exporting.export(outcome.best, tmp_path / "best.onnx")
    assert exported.evaluation == best
    assert exported.card.provenance.relative_thrust == best.relative_thrust


def test_a_resumed_training_keeps_the_best_policy(tmp_path: Path, beating: list[Policy]) -> None:
    beating[:] = [square(6), square(5), square(6), still, square(5)]
    job = on_robot(tmp_path / "run")
    training = storing_training(job, Resting(job))
    first = training.run().best_evaluation
    more = replace(job, resume=True, settings=replace(job.settings, steps=256))
    again = storing_training(more, Resting(more))
    former = again._recorder.winner
    assert (former.steps, former.swims, former.swim_time, former.thrust) == (
        64,
        2,
        7.0,
        first.thrust,
    )
    second = again.run()
    assert second.best == job.folder / "best-000064"
    assert same(second.best, training.networks[64])
    assert rows(job.folder / "evaluations.csv")[-1]["steps"] == "256"


def test_a_killed_training_resumes_with_its_best(tmp_path: Path, beating: list[Policy]) -> None:
    job = on_robot(tmp_path / "run", steps=128, checkpoint_every=64)
    outcome = Training(job, Resting(job), Display(), lambda: False).run()
    best, step = outcome.best_evaluation, job.folder / "step-000128"
    state = checkpoints.read_state(step)
    older = replace(state, best=replace(state.best, policy=0, thrust=0.001), swims=1)
    (step / "state.json").write_bytes(msgspec.json.encode(older))
    more = replace(job, resume=True, settings=replace(job.settings, steps=192))
    recorder = Training(more, Resting(more), Display(), lambda: False)._recorder
    assert recorder.best == best
    assert (recorder.winner.steps, recorder.winner.thrust) == (best.policy, best.thrust)


def test_a_training_resumes_without_a_moved_policy(tmp_path: Path, beating: list[Policy]) -> None:
    job = on_robot(tmp_path / "run", steps=64)
    outcome = Training(job, Resting(job), Display(), lambda: False).run()
    outcome.best.rename(tmp_path / "elsewhere")
    more = replace(job, resume=True, settings=replace(job.settings, steps=128))
    again = Training(more, Resting(more), Display(), lambda: False).run()
    assert again.best == job.folder / "best-000128"


def test_a_stop_in_an_evaluation_keeps_measurements(tmp_path: Path, beating: list[Policy]) -> None:
    job = on_robot(tmp_path / "run", steps=6400)
    link = Resting(job)
    ended = 64 + 150 + 64 + 120  # in the swim of the second evaluation
    training = Training(job, link, Display(), lambda: len(link.shown) > ended)
    outcome = training.run()
    assert (outcome.ended, outcome.steps) == ("interrupted", 128)
    assert outcome.best == job.folder / "best-000064"
    assert [row["steps"] for row in rows(job.folder / "progress.csv")] == ["64", "128"]
    assert [row["steps"] for row in rows(job.folder / "evaluations.csv")] == ["64"]
    assert outcome.checkpoint == job.folder / "step-000128"


def test_a_fish_lost_in_an_evaluation_loses_nothing(tmp_path: Path, beating: list[Policy]) -> None:
    job = on_robot(tmp_path / "run")
    lost = storing_training(job, Failing(job, 64 + 150 + 64 + 190))
    outcome = lost.run()
    assert (outcome.ended, outcome.steps) == ("lost", 128)
    assert outcome.best
    assert [row["steps"] for row in rows(job.folder / "progress.csv")] == ["64", "128"]
    assert [row["policy"] for row in rows(job.folder / "evaluations.csv")] == ["64", "128"]
    assert outcome.checkpoint == job.folder / "step-000128"
    assert same(outcome.checkpoint, lost.networks[128])
    link = SimulatedLink(job.config)
    again = Training(replace(job, resume=True), link, Display(), lambda: False).run()
    assert (again.ended, again.steps) == ("finished", 192)


def test_the_initial_policy_may_stay_the_best(tmp_path: Path, beating: list[Policy]) -> None:
    job = on_robot(tmp_path / "parent", steps=64)
    first = Training(job, Resting(job), Display(), lambda: False).run()
    beating[:] = [square(5), square(6)]
    child = on_robot(tmp_path / "child", steps=64, parent=first.best)
    outcome = Training(child, Resting(child), Display(), lambda: False).run()
    assert outcome.best == child.folder / "best-000000"
    assert same(outcome.best, checkpoints.load_policy(first.best)[0].state_dict())


def test_a_fishd_in_lockstep_gives_the_same_evaluations_as_a_simulation(tmp_path: Path) -> None:
    changes = {"steps": 256, "seed": 249, "ppo": PpoSettings()}
    here = on_robot(tmp_path / "here", **changes)
    Training(here, SimulatedLink(here.config), Display(), lambda: False).run()
    agent = f"start.parameters.agent=ipc://{tmp_path}/agent"
    started = sets("lockstep=true", "start.controller=remote", agent, *NOISY)
    with running(tmp_path, *started) as daemon:
        there = on_robot(tmp_path / "there", **changes)
        train(replace(there, endpoint=daemon.endpoint))
        with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
            assert fish.status().mode == "idle"
    assert any(row["thrust_ci95"] for row in rows(here.folder / "evaluations.csv"))
    for name in ("progress.csv", "evaluations.csv"):
        assert (here.folder / name).read_text() == (there.folder / name).read_text()
