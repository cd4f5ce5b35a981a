"""config/harsh.yaml: a rig with every imperfection that fishd simulates."""

import msgspec
import pytest
from rigs.documents import ROOT

from fishd.config import load
from fishd.lab.simulation import simulate
from fishd.lab.simulation.virtual_run import KeepingPublisher
from fishd.virtual.imperfections import SimulationSettings
from fishd.virtual.plant.parameters import PlantParameters

FILE = ROOT / "config" / "harsh.yaml"
KEYS_AS_DEFAULT = {
    "plant": {
        *("model", "omega0", "xi", "coupling", "servo_speed", "servo_lag", "servo_law"),
        *("thrust_coefficient", "lateral_inertia_ratio"),
    },
    "simulation": {"drift_period", "drift_rate", "hum_frequency", "motor", "sample_rate", "seed"},
}
"""Keys that are not imperfections, or that belong to an imperfection of the rig."""


@pytest.mark.parametrize(
    ("section", "defaults"), [("plant", PlantParameters()), ("simulation", SimulationSettings())]
)
def test_it_has_every_imperfection_that_there_is(section: str, defaults: msgspec.Struct) -> None:
    harsh = getattr(load(FILE), section)
    names = harsh.__struct_fields__
    same = {name for name in names if getattr(harsh, name) == getattr(defaults, name)}
    assert same == KEYS_AS_DEFAULT[section]


@pytest.mark.slow
def test_the_same_seed_swims_the_same_to_the_last_bit_and_another_one_does_not() -> None:
    def ticks(*overrides: str) -> list[tuple[float, ...]]:
        publisher = KeepingPublisher()
        simulate(load(FILE, overrides), "swing", {"C": 0.6}, 3.0, 1.0, publisher)
        return [(t.fx, t.fy, t.phi_c, t.alpha, t.alpha_rate) for t in publisher.ticks]

    first = ticks()
    assert ticks() == first
    assert ticks("simulation.seed=1") != first


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["simulated", "virtual-pi"])
def test_a_square_wave_swims_on_it_as_well_as_its_frequency_permits(robot: str) -> None:
    config = load(FILE, [f"robot={robot}"])
    best = simulate(config, "square", {"frequency": 1.6}, 5.0, 3.0)
    assert best.mode == "running"
    assert 0.9 < best.relative_thrust < 1.03
    assert best.best_square_thrust < 0.5 * 0.0258  # of a fish without imperfections
