"""Whatever a policy wants, and whatever fish it is on: the servo is not shaken."""

from itertools import pairwise
from pathlib import Path

import pytest
from rigs.harness import Rig
from rigs.policy_files import card, random_layers

from fishd.controllers.policy.card import FeatureName
from fishd.controllers.policy.network import to_onnx
from fishd.core.signals import Tick

FEATURES: tuple[tuple[FeatureName, float], ...] = (
    ("fy", 0.39),
    ("fy_rate", 4.9),
    ("instruction_angle", 0.42),
    ("previous_angle", 0.42),
    ("fin_velocity", 0.031),
)
FISH = {
    "delay": ("plant.servo_delay=0.08",),
    "backlash": ("plant.backlash=0.15",),
    "drag": ("plant.lateral_drag=0.399",),
    "all": ("plant.servo_delay=0.08", "plant.backlash=0.15", "plant.lateral_drag=0.399"),
    "reversed F_y": ("simulation.rotation=3.1",),
}


def most_reversals_in_consecutive_ticks(ticks: list[Tick]) -> int:
    run = longest = 0
    for before, now in pairwise(ticks):
        run = run + 1 if before.phi_c * now.phi_c < 0.0 else 0
        longest = max(longest, run)
    return longest


@pytest.mark.parametrize("fish", FISH.values(), ids=FISH)
@pytest.mark.parametrize("gain", [1.0, 30.0])
def test_no_policy_with_random_weights_reverses_in_consecutive_ticks(
    tmp_path: Path, fish: tuple[str, ...], gain: float
) -> None:
    """gain: 1 is a network that nobody has trained, 30 one that goes to an end at each trifle."""
    for seed in range(3):
        layers = random_layers(5, 16, 16, 1, seed=seed)
        weight, bias = layers[-1]
        layers[-1] = weight * gain, bias * gain
        path = tmp_path / f"{seed}.onnx"
        path.write_bytes(to_onnx(layers, "tanh", card(*FEATURES)))
        rig = Rig("simulation.noise=2e-3", f"simulation.seed={seed}", *fish)
        rig.start("ppo", policy=str(path))
        ticks = rig.run_for(12.0)
        assert rig.mode == "running"
        assert most_reversals_in_consecutive_ticks(ticks) <= 1
