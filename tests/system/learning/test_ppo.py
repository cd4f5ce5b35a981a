"""The rollout without void steps, the learning rate, and networks with left-right symmetry."""

from typing import Literal

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from rigs.harness import observe
from rigs.policy_files import vector
from stable_baselines3.common.policies import ActorCriticPolicy

from fishd.controllers.policy.card import Feature
from fishd.learning.env.environment import spaces
from fishd.learning.env.perception import Perception
from fishd.learning.ppo import DeterministicPolicy, Rollout, layers_of, learning_rate, make_policy
from fishd.learning.settings import PpoSettings

FEATURES = (Feature("fy", 0.4), Feature("instruction_angle", 0.42))


def rollout(rewards: list[float], void: int | None = None) -> Rollout:
    """Return a full rollout of one episode; the step after a void one begins another."""
    observation, action = spaces(2)
    buffer = Rollout(len(rewards), observation, action, "cpu", gae_lambda=0.95, gamma=0.9)
    starts = False
    for k, reward in enumerate(rewards):
        buffer.void[buffer.pos] = k == void
        buffer.add(
            np.full((1, 2), k, np.float32),
            np.zeros((1, 1), np.float32),
            np.array([reward]),
            np.array([starts]),
            torch.tensor([[0.1 * k]]),
            torch.tensor([-0.5]),
        )
        starts = k == void
    buffer.compute_returns_and_advantage(torch.zeros(1, 1), np.array([False]))
    return buffer


def test_the_outcome_of_a_void_step_changes_no_advantage() -> None:
    calm = rollout([0.3] * 12, void=5)
    wild = rollout([0.3] * 5 + [1e6] + [0.3] * 6, void=5)
    np.testing.assert_array_equal(calm.advantages, wild.advantages)
    assert calm.advantages[5] == 0.0


def test_a_void_step_is_in_no_minibatch() -> None:
    def steps_of_batches(buffer: Rollout) -> list[int]:
        return sorted(int(o) for batch in buffer.get(4) for o in batch.observations[:, 0])

    assert steps_of_batches(rollout([0.3] * 12)) == list(range(12))
    assert steps_of_batches(rollout([0.3] * 12, void=5)) == [*range(5), *range(6, 12)]


def test_the_learning_rate_falls_with_the_steps_since_the_beginning_and_then_stays() -> None:
    ppo = PpoSettings(learning_rate=1e-2, final_learning_rate=1e-3, decay_steps=1000)
    rates = [learning_rate(ppo, steps) for steps in (0, 500, 1000, 5000)]
    assert rates == pytest.approx([1e-2, 5.5e-3, 1e-3, 1e-3])


@pytest.mark.parametrize("activation", ["tanh", "relu"])
@pytest.mark.parametrize("symmetric", [True, False])
def test_the_policy_in_numpy_is_that_of_stable_baselines(
    activation: Literal["tanh", "relu"], symmetric: bool
) -> None:
    torch.manual_seed(0)
    ppo = PpoSettings(hidden=(16, 8), activation=activation, symmetric=symmetric)
    policy = make_policy(ppo, 2)
    with torch.no_grad():
        policy.action_net.weight *= 100.0  # so that some actions are clipped
    decide = DeterministicPolicy(policy, Perception(FEATURES), 0.42)
    angles = []
    for angle in np.linspace(-0.42, 0.42, 21):
        observation = observe(float(angle))
        action, _ = policy.predict(vector(FEATURES, observation), deterministic=True)
        angles.append(decide(observation))
        assert angles[-1] == pytest.approx(0.42 * float(action[0]), abs=1e-5)
    assert len(set(angles)) > 2


@pytest.fixture(params=[(), (0, 2)], ids=["odd inputs", "two even inputs"])
def even(request: pytest.FixtureRequest) -> tuple[int, ...]:
    """Indices of the inputs that are the same for the mirrored fish."""
    return request.param  # type: ignore[no-any-return]


@pytest.fixture
def policy(even: tuple[int, ...]) -> ActorCriticPolicy:
    torch.manual_seed(0)
    policy = make_policy(PpoSettings(hidden=(16, 8), symmetric=True), 4, even=even)
    with torch.no_grad():
        for parameter in policy.parameters():
            if parameter.requires_grad:  # as after learning, biases too
                parameter.normal_(0.0, 0.7)
    return policy


@pytest.fixture
def seen() -> NDArray[np.float32]:
    return np.random.default_rng(0).normal(0.0, 1.5, (50, 4)).astype(np.float32)


@pytest.fixture
def mirrored(seen: NDArray[np.float32], even: tuple[int, ...]) -> NDArray[np.float32]:
    """Inputs of the mirrored fish."""
    return np.where(np.isin(np.arange(4), even), seen, -seen)


def test_a_mirrored_fish_is_mirrored(
    policy: ActorCriticPolicy, seen: NDArray[np.float32], mirrored: NDArray[np.float32]
) -> None:
    actions, _ = policy.predict(seen, deterministic=True)
    others, _ = policy.predict(mirrored, deterministic=True)
    assert np.ptp(actions) > 0.5
    assert others == pytest.approx(-actions, abs=1e-6)


def test_a_mirrored_state_is_as_good(
    policy: ActorCriticPolicy, seen: NDArray[np.float32], mirrored: NDArray[np.float32]
) -> None:
    with torch.no_grad():
        values = policy.predict_values(torch.from_numpy(seen)).numpy()
        others = policy.predict_values(torch.from_numpy(mirrored)).numpy()
    assert np.ptp(values) > 0.5
    assert others == pytest.approx(values, abs=1e-5)


def test_layers_give_the_same_output(policy: ActorCriticPolicy, seen: NDArray[np.float32]) -> None:
    *hidden, (last, bias) = layers_of(policy)
    values = seen
    for weight, offset in hidden:
        values = np.tanh(values @ weight.T + offset)
    with torch.no_grad():
        expected = policy.get_distribution(torch.from_numpy(seen)).distribution.mean.numpy()
    assert values @ last.T + bias == pytest.approx(expected, abs=1e-4)
    assert [weight.shape for weight, _ in (*hidden, (last, bias))] == [(32, 4), (16, 32), (1, 16)]
    assert all(weight.dtype == np.float32 for weight, _ in hidden)
