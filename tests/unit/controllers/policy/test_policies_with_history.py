"""Policies that see the latest ticks: what they are given, from when on, and where."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from rigs.harness import LIMITS, observe
from rigs.policy_files import card, linear, random_layers, write

from fishd.controllers import registry
from fishd.controllers.base import Limits
from fishd.controllers.policy.card import Card, Feature, FeatureName, History, Window
from fishd.controllers.policy.network import to_onnx
from fishd.controllers.policy.runtime import Pilot
from fishd.core.signals import Observation

FREE = Limits(LIMITS.amplitude, LIMITS.tick, dwell=0.0)


def remembering(ticks: int, *features: tuple[FeatureName, float]) -> Card:
    return replace(card(*features), history=ticks)


def seen(tick: int, angle: float = 0.0, fy: float = 0.0) -> Observation:
    return replace(observe(angle), time=100.0 + 0.05 * tick, fy=fy)


def history(ticks: int) -> History:
    features = (Feature("fy", 0.1), Feature("instruction_angle", 0.42))
    return History(features, Window(ticks, 0.05 * ticks))


def test_a_network_sees_the_latest_ticks_newest_first(tmp_path: Path) -> None:
    path = write(tmp_path, to_onnx(linear(0.0, 0.0, 1.0), "tanh", remembering(3)))
    controller = registry.create("ppo", {"policy": str(path)}, FREE)
    angles = [0.1, 0.2, -0.3, 0.4, -0.1]
    controller.activate(seen(0, angles[0]))
    given = []
    for tick, angle in enumerate(angles):
        given.append(controller.update(seen(tick, angle)))
    assert given == pytest.approx([0.1, 0.1, 0.1, 0.2, -0.3], abs=1e-6)


def test_a_policy_that_is_active_again_has_forgotten_what_it_saw(tmp_path: Path) -> None:
    path = write(tmp_path, to_onnx(linear(0.0, 1.0), "tanh", remembering(2)))
    controller = registry.create("ppo", {"policy": str(path)}, FREE)
    controller.update(seen(0, 0.3))
    controller.activate(seen(1, -0.2))
    assert controller.update(seen(1, -0.2)) == pytest.approx(-0.2, abs=1e-6)


def test_a_policy_outside_of_the_loop_answers_alike(tmp_path: Path) -> None:
    features: tuple[tuple[FeatureName, float], ...] = (("fy", 0.02), ("instruction_angle", 0.42))
    content = to_onnx(random_layers(8, 16, 1), "tanh", remembering(4, *features))
    path = write(tmp_path, content)
    controller, pilot = registry.create("ppo", {"policy": str(path)}, FREE), Pilot(str(path), FREE)
    random = np.random.default_rng(0)
    for tick in range(20):
        observation = seen(tick, *random.normal(0.0, (0.3, 0.1)).tolist())
        assert controller.update(observation) == pilot.angle(observation)


def test_a_tick_that_comes_again_is_the_same_one_and_after_a_gap_the_history_begins_anew() -> None:
    latest = history(3)
    for tick in (0, 1, 1, 2):
        latest.push(seen(tick, 0.042 * tick))
    assert latest.row[1::2].tolist() == pytest.approx([0.2, 0.1, 0.0])
    latest.push(seen(4, 0.42))  # one tick was missed
    assert latest.row[1::2].tolist() == pytest.approx([1.0, 0.2, 0.1])
    latest.push(seen(8, -0.42))
    assert latest.row[1::2].tolist() == pytest.approx([-1.0] * 3)
    latest.push(seen(6, 0.21))  # another fish
    assert latest.row[1::2].tolist() == pytest.approx([0.5] * 3)
