from pathlib import Path

import pytest

from fishd.errors import ConfigError
from fishd.learning.settings import TrainingSettings, load, to_yaml

CONFIG = Path(__file__).parents[2] / "config"


def complaint(folder: Path, text: str) -> str:
    file = folder / "learning.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load(file)
    assert "\n" not in str(caught.value)
    return str(caught.value).removeprefix(f"{folder}/")


def test_the_shipped_file_holds_the_defaults_and_every_key() -> None:
    shipped = CONFIG / "learning.yaml"
    assert load(shipped) == TrainingSettings()
    keys = {line.strip() for line in to_yaml(TrainingSettings()).splitlines() if ":" in line}
    text = shipped.read_text(encoding="utf-8")
    assert all(f"{key.partition(':')[0]}:" in text for key in keys)


def test_the_setting_of_the_paper_updates_every_768_steps() -> None:
    paper = load(CONFIG / "learning-paper.yaml")
    assert (paper.steps, paper.ppo.n_steps, paper.ppo.decay_steps) == (100_000, 768, 10_000)
    assert paper.environment.observation == ("fy", "fy_rate", "instruction_angle")


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    paper = load(CONFIG / "learning-paper.yaml")
    (tmp_path / "settings.yaml").write_text(to_yaml(paper), encoding="utf-8")
    assert load(tmp_path / "settings.yaml") == paper


def test_a_wrong_value_is_one_line_that_names_file_line_key_and_what_is_needed(
    tmp_path: Path,
) -> None:
    assert complaint(tmp_path, "steps: 100\nppo:\n  gamma: 2.0\n") == (
        "learning.yaml:3: ppo.gamma: 2.0 is not valid: a number in [0, 1] is needed"
    )


def test_an_unknown_key_names_the_nearest(tmp_path: Path) -> None:
    assert "did you mean 'n_steps'" in complaint(tmp_path, "ppo:\n  nsteps: 64\n")
    assert complaint(tmp_path, "randomization:\n  xi: 0.1\n").startswith("learning.yaml:1:")


def test_an_observation_that_does_not_exist_is_named(tmp_path: Path) -> None:
    found = complaint(tmp_path, "environment:\n  observation: [fy, alpha]\n")
    assert "environment.observation" in found
    assert "instruction_angle" in found


def test_a_batch_that_does_not_divide_the_rollout_is_refused(tmp_path: Path) -> None:
    assert complaint(tmp_path, "ppo:\n  n_steps: 100\n  batch_size: 64\n") == (
        "learning.yaml:3: ppo.batch_size: 64 is not valid: n_steps, 100, must be a multiple of it"
    )


def test_an_evaluation_must_be_longer_than_it_may_settle(tmp_path: Path) -> None:
    found = complaint(tmp_path, "evaluation:\n  seconds: 4.0\n")
    assert "evaluation.settle: 5 s is not valid: less than seconds, 4 s, is needed" in found


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: no such file"):
        load(tmp_path / "none.yaml")


def test_a_network_needs_a_hidden_layer(tmp_path: Path) -> None:
    found = complaint(tmp_path, "ppo:\n  hidden: []\n")
    assert found.startswith("learning.yaml:2: ppo.hidden: [] is not valid: ")


def test_nothing_is_seen_twice(tmp_path: Path) -> None:
    assert complaint(tmp_path, "environment:\n  observation: [fy, fy]\n") == (
        "learning.yaml:2: environment.observation: ['fy', 'fy'] is not valid: each may be in it "
        "once"
    )
