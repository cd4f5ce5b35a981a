import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import RenderCollection
from msgspec.structs import replace
from rigs.processes import PATIENCE, Daemon, running, sets
from rigs.swimming import BRIEF, Resting, brief_job
from stable_baselines3.common.env_checker import check_env as check_for_baselines

import fishd.learning  # noqa: F401 (registers the environments)
from fishd.client import Fish
from fishd.config import load
from fishd.core.errors import ConfigError
from fishd.learning.env.environment import SwimEnv
from fishd.learning.links.simulated_link import SimulatedLink
from fishd.learning.settings import EnvironmentSettings

STILL = ("simulation.noise=0.0",)


@pytest.mark.parametrize("mode", [None, "rgb_array"])
def test_the_environment_in_process_passes_both_checkers(mode: str | None) -> None:
    env = gymnasium.make("fishd/Swim-v0", overrides=("simulation.noise=0.001",), render_mode=mode)
    check_env(env.unwrapped)
    check_for_baselines(env.unwrapped, warn=True)


def test_pictures_show_the_tail_from_above() -> None:
    env = RenderCollection(
        gymnasium.make("fishd/Swim-v0", overrides=STILL, render_mode="rgb_array")
    )
    assert env.metadata["render_fps"] == 20
    env.reset(seed=1)
    for _ in range(8):
        env.step(np.ones(1, np.float32))
    pictures: Any = env.render()
    assert [(picture.shape, picture.dtype) for picture in pictures] == [((256, 256, 3), "u1")] * 9
    alpha = env.unwrapped.link.truth().alpha  # type: ignore[attr-defined]
    dark = np.argwhere(pictures[-1][:, 200, 0] < 130).mean()
    assert alpha > 0.1
    assert dark > 127.5 + 20
    assert np.array_equal(pictures[-1][:, :, 0], pictures[-1][:, :, 2])
    assert env.render() == []


def test_the_frame_rate_of_pictures_is_that_of_ticks() -> None:
    env = gymnasium.make("fishd/Swim-v0", overrides=("tick=0.02",), render_mode="rgb_array")
    assert env.metadata["render_fps"] == 50
    with pytest.raises(ResetNeeded, match="call reset before render"):
        env.unwrapped.render()


def test_an_environment_without_render_mode_draws_nothing() -> None:
    env = gymnasium.make("fishd/Swim-v0").unwrapped
    env.reset()
    assert env.render() is None


@pytest.mark.parametrize(
    ("name", "mode", "words"),
    [
        ("fishd/Swim-v0", "human", "render_mode='human' is not valid: 'rgb_array' is needed"),
        ("fishd/SwimOnDaemon-v0", "rgb_array", "the true angles of this fish are unknown"),
    ],
)
def test_another_render_mode_is_refused_in_one_sentence(name: str, mode: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        gymnasium.make(name, render_mode=mode)


def test_an_environment_is_made_from_the_files_of_fish_and_training(tmp_path: Path) -> None:
    (tmp_path / "fish.yaml").write_text("amplitude_limit: 0.2\n", encoding="utf-8")
    settings = tmp_path / "training.yaml"
    settings.write_text("environment:\n  observation: [fy]\n  episode: 3\n", encoding="utf-8")
    env = gymnasium.make("fishd/Swim-v0", config=tmp_path / "fish.yaml", settings=str(settings))
    observation, _ = env.reset(seed=1)
    assert observation.shape == (1,)
    swim = env.unwrapped
    assert swim.link.amplitude == 0.2
    ends = [env.step(np.ones(1, np.float32))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_the_same_seed_swims_the_same_way() -> None:
    def course(seed: int) -> list[float]:
        env = gymnasium.make("fishd/Swim-v0", overrides=("simulation.noise=0.001",))
        env.reset(seed=seed)
        return [float(env.step(np.array([(-1.0) ** (k // 6)]))[1]) for k in range(40)]

    assert course(3) == course(3)
    assert course(3) != course(4)


def test_randomised_fish_differ_from_episode_to_episode(tmp_path: Path) -> None:
    (tmp_path / "training.yaml").write_text("randomisation:\n  omega0: 0.2\n", encoding="utf-8")
    env = gymnasium.make("fishd/Swim-v0", settings=tmp_path / "training.yaml")
    swim = env.unwrapped
    frequencies = []
    for _ in range(5):
        env.reset()
        frequencies.append(swim.link.config.plant.omega0)  # type: ignore[attr-defined]
    assert len(set(frequencies)) == 5
    assert all(12.5 / 1.2 <= omega0 <= 12.5 * 1.2 for omega0 in frequencies)


def test_after_a_pause_the_agent_sees_the_present_state_of_the_fish(tmp_path: Path) -> None:
    job = brief_job(tmp_path)
    env = SwimEnv(Resting(job), load(None, STILL), BRIEF.environment)
    env.reset(seed=1)
    for k in range(40):
        before, *_ = env.step(np.array([(-1.0) ** (k // 6)], np.float32))
    tank_time = env.tank_time
    env.pause(60.0)
    after = env.resume()
    angle = BRIEF.environment.observation.index("instruction_angle")
    assert abs(before[angle]) == 1.0
    assert after[angle] == 0.0
    *_, info = env.step(np.zeros(1, np.float32))
    assert info["paused"] == pytest.approx(3.0)
    assert env.tank_time == pytest.approx(tank_time + 3.0 + 0.05)
    *_, info = env.step(np.zeros(1, np.float32))
    assert info["paused"] == 0.0


@pytest.mark.parametrize("swims", [False, True])
def test_from_rest_a_tail_may_beat_to_either_side(tmp_path: Path, swims: bool) -> None:
    settings = EnvironmentSettings(longest_start=0)
    link = SimulatedLink(load(None, STILL)) if swims else Resting(brief_job(tmp_path))
    env = SwimEnv(link, load(None, STILL), settings)
    env.reset(seed=1)
    for share in (1.0, 1.0, 1.0, 1.0, -1.0):
        env.step(np.array([share], np.float32))
    env.pause(60.0)
    if swims:  # outside of an episode, as in an evaluation in the tank
        env.resume()
        for _ in range(20):
            env.advance(0.0)
        env.pause(60.0)
    env.resume()
    env.step(np.ones(1, np.float32))
    assert env.latest.instruction_angle == 0.42


def test_where_no_time_has_passed_a_pause_ends_no_dwell() -> None:
    config = load(None, STILL)
    env = SwimEnv(SimulatedLink(config), config, EnvironmentSettings(longest_start=0))
    env.reset(seed=1)
    env.step(np.ones(1, np.float32))
    sides = ""
    for _ in range(4):
        env.pause(60.0)
        env.resume()
        env.step(-np.ones(1, np.float32))
        sides += "+" if env.latest.instruction_angle > 0 else "-"
    assert sides == "+++-"


def test_an_action_that_is_not_one_number_is_refused_and_one_beyond_its_space_clipped() -> None:
    env = gymnasium.make("fishd/Swim-v0").unwrapped
    env.reset(seed=1)
    invalid: list[Any] = [[np.nan], np.array([-np.inf], np.float32), 0.5, [], None]
    invalid.append(np.zeros((1, 1)))
    for action in invalid:
        with pytest.raises(ValueError, match=r"^an action of .* is not valid: (a number|\(1,\)) i"):
            env.step(action)
    env.step([7])
    assert env.latest.instruction_angle == 0.42  # type: ignore[attr-defined]


def applied(settings: EnvironmentSettings, *overrides: str) -> tuple[str, float]:
    """Return the side applied in each of twelve ticks with a requested reversal, and the reward.

    The reward of the thrust is negligible.
    """
    config = load(None, [*STILL, *overrides])
    env = SwimEnv(SimulatedLink(config), config, replace(settings, thrust_scale=1e9))
    env.reset(seed=1)
    env.swim(0.42)
    sides, rewards = "", 0.0
    for _ in range(12):
        action = -np.sign([env.latest.instruction_angle])
        rewards += float(env.step(action)[1])
        sides += "+" if env.latest.instruction_angle > 0 else "-"
    return sides, rewards


def test_a_reversal_that_ppo_would_delay_is_delayed_and_costs() -> None:
    settings = EnvironmentSettings(longest_start=0, reward_scale=2.0, held_cost=0.25)
    sides, reward = applied(settings)
    assert sides == "+++----++++-"
    assert reward == pytest.approx(-9 * 0.5, abs=1e-6)
    assert applied(settings, "plant.servo_delay=0.08")[0] == "++++-----+++"  # dwell 0.25 s
    assert applied(settings, "chatter.dwell=0")[0] == "-+-+-+-+-+-+"


def test_a_training_may_switch_the_shortest_dwell_off() -> None:
    sides, reward = applied(EnvironmentSettings(longest_start=0, dwell=False))
    assert (sides, reward) == ("-+-+-+-+-+-+", pytest.approx(0.0, abs=1e-6))


def test_a_step_before_the_first_episode_or_after_the_end_is_an_error() -> None:
    env = gymnasium.make("fishd/Swim-v0").unwrapped
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before step"):
        env.step(np.zeros(1))
    env.reset()
    env.close()
    with pytest.raises(RuntimeError, match="this environment is closed"):
        env.step(np.zeros(1))
    with pytest.raises(RuntimeError, match="this environment is closed"):
        env.reset()
    env.close()


def test_the_requested_pause_follows_the_longest_before(monkeypatch: pytest.MonkeyPatch) -> None:
    requested: list[float] = []
    now = 1000.0

    class PauseRecorder(SimulatedLink):
        def pause(self, seconds: float) -> None:
            requested.append(seconds)

    env = SwimEnv(PauseRecorder(load(None)), load(None), EnvironmentSettings())
    env.reset(seed=1)
    monkeypatch.setattr(time, "monotonic", lambda: now)
    for duration in (0.5, 5.0, 1.0, 60.0, 0.0):
        env.pause()
        now += duration
        env.resume()
    assert requested == [120.0, 10.0, 20.0, 20.0, 120.0]
    env.pause(300.0)
    assert requested[-1] == 300.0


def test_the_environment_on_a_fishd_passes_both_checkers(daemon: Daemon, tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/agent"
    # A busy machine may delay the checkers by many ticks.
    with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
        fish.set_controller("remote", agent=address, misses=100)
    env = gymnasium.make("fishd/SwimOnDaemon-v0", endpoint=daemon.endpoint, agent=address).unwrapped
    try:
        check_env(env, skip_render_check=True, skip_close_check=True)
        check_for_baselines(env, warn=True)
    finally:
        env.close()


def test_the_environment_on_a_running_fishd_listens_at_the_given_address(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/agent"
    with running(tmp_path, *sets("lockstep=true")) as daemon:  # fishd waits for its agent
        env = gymnasium.make("fishd/SwimOnDaemon-v0", endpoint=daemon.endpoint, agent=address)
        try:
            env.reset()
            with Fish(daemon.endpoint, timeout=PATIENCE) as fish:
                assert fish.status().parameters["agent"] == address
        finally:
            env.close()


def test_no_policy_learns_from_a_fin_velocity_that_it_would_not_receive() -> None:
    with pytest.raises(ConfigError, match="observer is not possible with fin_velocity"):
        gymnasium.make("fishd/Swim-v0", overrides=("estimator.kind=observer",))


def test_power_with_a_price_is_subtracted_from_the_reward() -> None:
    config, rewards = load(None), []
    for price in (0.0, 0.01):
        link, settings = SimulatedLink(config), EnvironmentSettings(power_price=price)
        env = SwimEnv(link, config, settings)
        env.reset(seed=1)
        rewards.append(env.step(np.array([1.0], np.float32))[1])
        assert link.step(0.42).observation.readings["power"] > 0.06
    assert rewards[1] < rewards[0] - 0.3 * 0.01 * 0.06 / env.best_thrust


def test_power_that_is_not_known_can_have_no_price() -> None:
    config = load(None)
    env = SwimEnv(
        SimulatedLink(config, metered=False),
        config,
        EnvironmentSettings(power_price=0.01, longest_start=0),
    )
    env.reset(seed=1)
    with pytest.raises(ConfigError, match=r"power_price: this fish has no reading power"):
        env.step(np.array([1.0], np.float32))


def test_readings_are_inputs_of_an_agent_and_those_that_a_fish_lacks_are_refused() -> None:
    water = "sensors.water={kind: simulated, value: 15, amplitude: 0, low: 10, high: 30}"
    config = load(None, [water])
    settings = EnvironmentSettings(observation=("fy",), readings=("water_temperature",))
    env = SwimEnv(SimulatedLink(config, metered=False), config, settings)
    env.reset(seed=1)
    seen, *_ = env.step(np.array([1.0], np.float32))
    assert seen.shape == (2,)
    assert seen[1] == pytest.approx(-0.5)
    with pytest.raises(ConfigError, match="the fish has no reading water_temperature; it has powe"):
        SwimEnv(SimulatedLink(load(None)), load(None), settings)
