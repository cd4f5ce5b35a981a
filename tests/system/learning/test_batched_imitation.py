"""Imitation of the best waves of many fish that swim at once."""

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from rigs.swimming import brief_job

from fishd.controllers.policy.file import read
from fishd.core.errors import ConfigError
from fishd.lab.simulation import simulate
from fishd.learning.export import export
from fishd.learning.settings import (
    EnvironmentSettings,
    ImitationSettings,
    PpoSettings,
    Randomisation,
)
from fishd.learning.train.training import train

SEEN = ("fx", "fy", "instruction_angle", "side_time")
CHANGES = {
    "steps": 0,
    "environment": EnvironmentSettings(observation=SEEN, history=6),
    "randomisation": Randomisation(omega0=0.3, servo_delay=0.02, offset=0.01),
    "imitation": ImitationSettings(
        rounds=12, fish=64, batched=True, slow_fish=0.2, ticks=50, epochs=3, batch_size=128
    ),
    "ppo": PpoSettings(hidden=(32,)),
}


def test_a_policy_of_a_batch_swims_the_simulated_fish(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run", **CHANGES)
    best = train(job).best
    policy = export(best, tmp_path / "policy.onnx").path
    assert [feature.name for feature in read(policy).card.observation] == list(SEEN)
    for omega0 in (10.5, 12.5, 15.0):
        fish = replace(job.config, plant=replace(job.config.plant, omega0=omega0))
        report = simulate(fish, "ppo", {"policy": str(policy)}, seconds=20.0, settle=5.0)
        assert report.relative_thrust > 0.9


def test_a_training_stops_within_a_round(tmp_path: Path) -> None:
    answers = iter([False] * 40 + [True] * 99)
    outcome = train(brief_job(tmp_path / "run", **CHANGES), stop=lambda: next(answers))
    assert outcome.ended == "interrupted"


@pytest.mark.parametrize("changes", [{"quadratic_drag": 1.0}, {"servo_law": "linear"}])
def test_a_fish_with_other_equations_is_refused_before_the_training(
    changes: dict[str, Any], tmp_path: Path
) -> None:
    job = brief_job(tmp_path / "run", **CHANGES)
    fish = replace(job.config, plant=replace(job.config.plant, **changes))
    with pytest.raises(ConfigError, match=r"imitation\.batched: true is not valid for a fish"):
        train(replace(job, config=fish))
    assert not (tmp_path / "run").exists()
