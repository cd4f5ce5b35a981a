"""Learning from the best square waves of many fish, before PPO or in its place."""

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from rigs.swimming import brief_job, rows

from fishd.cli.progress import Lines
from fishd.config import load
from fishd.controllers.policy.file import read
from fishd.core.errors import ConfigError
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.env.fish_variation import draw_fish
from fishd.learning.export import export
from fishd.learning.imitation import advise_side, half_beat_thrusts, narrow, slow_down
from fishd.learning.run_folder import checkpoints
from fishd.learning.settings import EnvironmentSettings, ImitationSettings, Randomisation
from fishd.learning.train.jobs import Outcome
from fishd.learning.train.progress import ShownDisplay
from fishd.learning.train.training import train
from fishd.virtual.plant.optimum import best_square_wave

SEEN = ("fy", "instruction_angle", "fin_velocity", "side_time")
ENVIRONMENT = EnvironmentSettings(observation=SEEN, history=4)
SHORT_IMITATION = ImitationSettings(rounds=2, fish=10, ticks=60, batch_size=128)
CHANGES = {
    "steps": 0,
    "environment": ENVIRONMENT,
    "randomisation": Randomisation(omega0=0.3),
    "imitation": SHORT_IMITATION,
}


@pytest.fixture(scope="module")
def imitated(tmp_path_factory: pytest.TempPathFactory) -> tuple[Outcome, str]:
    """A run of imitation alone, which must not be changed, and its output."""
    with redirect_stdout(StringIO()) as output:
        job = brief_job(tmp_path_factory.mktemp("imitated") / "run", **CHANGES)
        return train(job, ShownDisplay(Lines(err=False))), output.getvalue()


def test_half_beats_have_their_relative_thrust() -> None:
    config = load(None, ["tick=0.02"])
    relative_thrust = half_beat_thrusts(config)
    best = best_square_wave(config.plant, config.amplitude_limit)
    assert relative_thrust[0] == 0.0
    assert relative_thrust.max() == 1.0
    assert relative_thrust.argmax() == round(0.5 / best.frequency / 0.02)


def test_a_clean_rig_keeps_the_fish_and_has_less_delay_and_play() -> None:
    spread = Randomisation(omega0=0.6, noise=1.0, servo_delay=0.08, backlash=0.1)
    clean = narrow(spread, 0.5, 0.25)
    assert (clean.omega0, clean.noise) == (0.3, 0.5)
    assert (clean.servo_delay, clean.backlash) == pytest.approx((0.01, 0.0125))
    assert narrow(spread, 1.0) == spread


def test_a_slow_fish_has_small_omega0_and_xi_of_the_range_and_is_the_same_otherwise() -> None:
    spread = Randomisation(omega0=0.6, xi=1.0, servo_speed=0.5)
    fish = draw_fish(load(None), spread, 1)
    slow = slow_down(fish, load(None).plant, spread, np.random.default_rng(1))
    assert 12.5 / 1.6 <= slow.plant.omega0 <= 12.5 / 1.6**0.3
    assert 1.2 / 2.0 <= slow.plant.xi <= 1.2 / 2.0**0.3
    assert replace(slow.plant, omega0=fish.plant.omega0, xi=fish.plant.xi) == fish.plant


def test_advice_for_many_fish_is_that_for_each() -> None:
    relative_thrust = np.array([[0.0, 0.5, 1.0, 0.9, 0.3], [0.0, 1.0, 0.8, 0.4, 0.1]])
    sides, costs = advise_side(relative_thrust, np.array([1, 7]))
    alone = [advise_side(relative_thrust[0], 1), advise_side(relative_thrust[1], 7)]
    assert [(float(s), float(c)) for s, c in alone] == list(zip(sides, costs, strict=True))


def test_the_advice_is_to_stay_until_the_best_half_beat_is_over() -> None:
    relative_thrust = np.array([0.0, 0.5, 1.0, 0.9, 0.3])
    sides, costs = zip(*(advise_side(relative_thrust, t) for t in range(6)), strict=True)
    assert sides == (1.0, 1.0, -1.0, -1.0, -1.0, -1.0)
    assert costs == pytest.approx((0.52, 0.52, 0.12, 0.62, 0.62, 0.62))


def test_imitation_alone_swims_and_is_named(tmp_path: Path, imitated: tuple[Outcome, str]) -> None:
    outcome, output = imitated
    assert outcome.ended == "finished"
    assert outcome.steps == 0
    assert outcome.best_evaluation.relative_thrust > 0.9
    assert "imitation 2 of 2: 9" in output
    past = read(export(outcome.best, tmp_path / "policy.onnx").path).card.provenance
    assert past.algorithm == "imitation"
    assert past.settings["imitation"]["fish"] == 10


def test_ppo_continues_with_the_imitated_policy(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run", **{**CHANGES, "steps": 64})
    train(job)
    first, *_ = rows(tmp_path / "run" / "evaluations.csv")
    assert (first["steps"], first["is_stalled"]) == ("0", "0")
    card = checkpoints.read_card(tmp_path / "run" / "step-000064")
    assert card.provenance.algorithm == "imitation and PPO"


def test_a_training_stopped_during_imitation_repeats_it(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run", **CHANGES)
    answers = iter([False] * 15 + [True] * 99)
    assert train(job, stop=lambda: next(answers)).ended == "interrupted"
    assert not checkpoints.read_state(tmp_path / "run" / "step-000000").imitated
    resumed = train(replace(job, resume=True))
    assert not resumed.best_evaluation.is_stalled
    with pytest.raises(ConfigError, match="is finished, with 0 steps"):
        train(replace(job, resume=True))


def test_a_child_does_not_imitate_again(tmp_path: Path, imitated: tuple[Outcome, str]) -> None:
    parent = imitated[0].best
    evaluations: list[Evaluation] = []
    display = ShownDisplay(Lines(err=False))
    display.evaluated = evaluations.append  # type: ignore[method-assign]
    more = {**CHANGES, "steps": 64}
    outcome = train(brief_job(tmp_path / "second", **more, parent=parent), display)
    assert [evaluation.steps for evaluation in evaluations] == [0, 64]
    assert checkpoints.read_state(outcome.checkpoint).imitated


def test_the_best_beat_of_a_robot_is_not_known(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"imitation\.rounds: the best beat of a robot's fish"):
        train(brief_job(tmp_path / "run", **CHANGES, on="live"))
    no_step = {**CHANGES, "steps": 0}
    nothing = brief_job(tmp_path / "run", **no_step, on="live", parent=tmp_path / "step-64")
    with pytest.raises(ConfigError, match="steps: 0 is not valid on a robot"):
        train(nothing)
    assert not (tmp_path / "run").exists()
