"""The policy that comes with fishd: its training, and its swims."""

import msgspec
import pytest
from rigs.documents import ROOT

from fishd.config import load
from fishd.controllers.policy import library
from fishd.controllers.policy.file import read
from fishd.lab.compare.survey import mild
from fishd.lab.simulation import simulate
from fishd.learning import settings as training

SETTINGS = ROOT / "config" / "learning-harsh.yaml"


def test_its_card_names_the_settings_of_the_documented_training() -> None:
    provenance = read(library.find("default-fish")).card.provenance
    settings = training.from_plain(provenance.settings)
    assert settings == training.load(SETTINGS)
    assert provenance.seed == settings.seed
    plant = msgspec.to_builtins(load().plant)
    assert provenance.plant == {key: plant[key] for key in provenance.plant}


@pytest.mark.parametrize("seed", range(300, 304))
def test_it_swims_fish_on_clean_rigs(seed: int) -> None:
    config = load(None, mild(seed).overrides)
    report = simulate(config, "ppo", {"policy": "default-fish"}, seconds=25.0, settle=10.0)
    assert report.relative_thrust > 0.9
    assert report.fallback is None


def test_it_starts_at_rest_on_a_rig_without_noise() -> None:
    config = load(None, ["simulation.noise=0"])
    report = simulate(config, "ppo", {"policy": "default-fish"}, seconds=25.0, settle=10.0)
    assert report.relative_thrust > 0.99
