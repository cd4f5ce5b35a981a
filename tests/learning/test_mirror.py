"""The policy with a mirror: what is known of left and right holds, whatever is learned."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch", reason="the extra 'learn' is not installed")
pytest.importorskip("stable_baselines3", reason="the extra 'learn' is not installed")

from fishd.errors import ConfigError
from fishd.learning.ppo import layers_of, make_policy
from fishd.learning.settings import PpoSettings, load

SHAPE = PpoSettings(hidden=(16, 8), symmetric=True)


@pytest.fixture
def policy():  # type: ignore[no-untyped-def]
    torch.manual_seed(0)
    made = make_policy(SHAPE, 4)
    with torch.no_grad():
        for parameter in made.parameters():
            if parameter.requires_grad:  # as if it had learned: biases too
                parameter.normal_(0.0, 0.7)
    return made


@pytest.fixture
def seen() -> NDArray[np.float32]:
    return np.random.default_rng(0).normal(0.0, 1.5, (50, 4)).astype(np.float32)


def test_a_mirrored_fish_gets_the_mirrored_answer(policy, seen) -> None:  # type: ignore[no-untyped-def]
    there, _ = policy.predict(seen, deterministic=True)
    mirrored, _ = policy.predict(-seen, deterministic=True)
    assert np.ptp(there) > 0.5
    assert mirrored == pytest.approx(-there)


def test_a_state_and_its_mirror_image_are_worth_the_same(policy, seen) -> None:  # type: ignore[no-untyped-def]
    with torch.no_grad():
        there = policy.predict_values(torch.from_numpy(seen)).numpy()
        mirrored = policy.predict_values(torch.from_numpy(-seen)).numpy()
    assert np.ptp(there) > 0.5
    assert mirrored == pytest.approx(there, abs=1e-5)


def test_as_plain_layers_it_says_the_same(policy, seen) -> None:  # type: ignore[no-untyped-def]
    *hidden, (last, bias) = layers_of(policy)
    values = seen
    for weight, offset in hidden:
        values = np.tanh(values @ weight.T + offset)
    with torch.no_grad():
        wanted = policy.get_distribution(torch.from_numpy(seen)).distribution.mean.numpy()
    assert values @ last.T + bias == pytest.approx(wanted, abs=1e-4)
    assert [weight.shape for weight, _ in (*hidden, (last, bias))] == [(32, 4), (16, 32), (1, 16)]
    assert all(weight.dtype == np.float32 for weight, _ in hidden)


def test_thrust_which_has_no_sign_to_change_must_not_be_seen(tmp_path: Path) -> None:
    file = tmp_path / "learning.yaml"
    file.write_text("environment:\n  observation: [fx, fy]\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"ppo\.symmetric: true is not valid where"):
        load(file)
    file.write_text(file.read_text() + "ppo:\n  symmetric: false\n", encoding="utf-8")
    assert not load(file).ppo.symmetric
