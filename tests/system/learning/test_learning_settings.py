from pathlib import Path

import pytest
from rigs.documents import ROOT

from fishd.core.errors import ConfigError
from fishd.learning.settings import TrainingSettings, load, to_yaml

CONFIG = ROOT / "config"


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


def test_written_settings_can_be_read_back(tmp_path: Path) -> None:
    paper = load(CONFIG / "learning-paper.yaml")
    (tmp_path / "settings.yaml").write_text(to_yaml(paper), encoding="utf-8")
    assert load(tmp_path / "settings.yaml") == paper


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "steps: 100\nppo:\n  gamma: 2.0\n",
            "learning.yaml:3: ppo.gamma: 2.0 is not valid: a number in [0, 1] is needed",
        ),
        ("ppo:\n  nsteps: 64\n", "did you mean 'n_steps'"),
        (
            "environment:\n  observation: [fy, alpha]\n",
            " | previous_angle | side_time is needed; 'alpha' is none of them",
        ),
        ("environment:\n  observation: [fy, fy]\n", "['fy', 'fy'] is not valid: each may be in"),
        ("ppo:\n  n_steps: 100\n  batch_size: 64\n", "n_steps, 100, must be a multiple of"),
        ("ppo:\n  hidden: 64\n", "whole numbers in [1, 1024] is needed: write [64]"),
        ("evaluation:\n  others: 3\n", "evaluation.others: 3 is not valid without a randomisation"),
        ("environment: {observation: []}", "the agent would see nothing"),
        ("see: camera\ncamera: {random_excitation: 64, memory: 16}", "less than a quarter of "),
        ("see: camera\ncamera: {feature_extractor: cnn, stack: {size: 67}}", "68 px or more"),
        ("see: camera\ncamera: {feature_extractor: nature, stack: {size: 35}}", "36 px or more"),
        ("see: camera\nsteps: 256", "more than the random excitation, 256 steps, is needed"),
        ("steps: 0", "steps: 0 is not valid without imitation.rounds"),
        (
            "see: both\nimitation: {rounds: 2}",
            "imitation.rounds: 2 is not valid with see: both; ",
        ),
        (
            "see: both\nenvironment: {observation: [fx, fy]}",
            "ppo.symmetric: true is not valid with pictures and fx",
        ),
        (
            "environment: {observation: [fy, fin_velocity]}\nimitation: {rounds: 1, batched: true}",
            "imitation.batched: true is not valid with fin_velocity",
        ),
        ("evaluation:\n  seconds: 4.0\n", "evaluation.settle: 5 s is not valid: less than "),
    ],
)
def test_a_wrong_value_is_one_line_that_names_file_line_key_and_what_is_needed(
    tmp_path: Path, text: str, message: str
) -> None:
    assert message in complaint(tmp_path, text)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: no such file"):
        load(tmp_path / "none.yaml")
