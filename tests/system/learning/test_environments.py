import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from msgspec.structs import replace
from rigs.processes import Daemon, running, sets
from rigs.swimming import BRIEF, Resting, brief_job
from stable_baselines3.common.env_checker import check_env as check_for_baselines

import fishd.learning  # noqa: F401 (registers the environments)
from fishd.client import Fish
from fishd.config import load
from fishd.core.errors import ConfigError, NoDaemon
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.link import StepResult
from fishd.learning.env.simulated_link import SimulatedLink
from fishd.learning.settings import EnvironmentSettings

STILL = ("simulation.noise=0.0",)


def test_the_environment_in_process_passes_both_checkers() -> None:
    env = gymnasium.make("fishd/Swim-v0", overrides=("simulation.noise=0.001",))
    check_env(env.unwrapped, skip_render_check=True)
    check_for_baselines(env.unwrapped, warn=True)


def test_it_takes_the_files_of_fish_and_training(tmp_path: Path) -> None:
    (tmp_path / "fish.yaml").write_text("amplitude_limit: 0.2\n", encoding="utf-8")
    (tmp_path / "training.yaml").write_text(
        "environment:\n  observation: [fy]\n  episode: 3\n", encoding="utf-8"
    )
    env = gymnasium.make(
        "fishd/Swim-v0", config=tmp_path / "fish.yaml", settings=str(tmp_path / "training.yaml")
    )
    observation, _ = env.reset(seed=1)
    assert observation.shape == (1,)
    swim = env.unwrapped
    assert isinstance(swim, SwimEnv)
    assert swim.link.amplitude == 0.2
    ends = [env.step(np.ones(1, np.float32))[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]


def test_a_wrong_override_is_one_line() -> None:
    with pytest.raises(ConfigError, match=r"plant\.omega: unknown key; did you mean 'omega0'"):
        gymnasium.make("fishd/Swim-v0", overrides=("plant.omega=3",))


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
    found = []
    for _ in range(5):
        env.reset()
        found.append(swim.link.config.plant.omega0)  # type: ignore[attr-defined]
    assert len(set(found)) == 5
    assert all(12.5 / 1.2 <= omega0 <= 12.5 * 1.2 for omega0 in found)


def test_after_a_pause_the_agent_sees_the_fish_as_it_is_now(tmp_path: Path) -> None:
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
    if swims:  # by itself, as in an evaluation in the tank
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
    invalid: list[Any] = [
        [np.nan],
        np.array([-np.inf], np.float32),
        0.5,
        np.zeros((1, 1)),
        [],
        None,
    ]
    for action in invalid:
        with pytest.raises(
            ValueError, match=r"^an action of .* is not valid: (a number in|\(1,\) is) "
        ):
            env.step(action)
    env.step([7])
    assert env.latest.instruction_angle == 0.42  # type: ignore[attr-defined]


def applied(settings: EnvironmentSettings, *overrides: str) -> tuple[str, float]:
    """Which side was applied in each of twelve ticks in which the other one was wanted, and reward.

    The reward is without that of thrust, for a fish that has none to speak of.
    """
    config = load(None, [*STILL, *overrides])
    env = SwimEnv(SimulatedLink(config), config, replace(settings, thrust_scale=1e9))
    env.reset(seed=1)
    env.swim(0.42)
    sides, rewards = "", 0.0
    for _ in range(12):
        wanted = -np.sign([env.latest.instruction_angle])
        rewards += float(env.step(wanted)[1])
        sides += "+" if env.latest.instruction_angle > 0 else "-"
    return sides, rewards


def test_a_reversal_that_ppo_would_hold_back_is_held_back_and_costs() -> None:
    settings = EnvironmentSettings(longest_start=0, reward_scale=2.0, held_cost=0.25)
    sides, reward = applied(settings)
    assert sides == "+++----++++-"
    assert reward == pytest.approx(-9 * 0.5, abs=1e-6)
    assert applied(settings, "plant.servo_delay=0.08")[0] == "++++-----+++"  # dwell 0.25 s
    assert applied(settings, "chatter.dwell=0")[0] == "-+-+-+-+-+-+"


def test_a_training_may_do_without_the_shortest_dwell() -> None:
    sides, reward = applied(EnvironmentSettings(longest_start=0, dwell=False))
    assert (sides, reward) == ("-+-+-+-+-+-+", pytest.approx(0.0, abs=1e-6))


def test_a_step_before_the_first_episode_and_after_the_end_says_what_is_wrong() -> None:
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


def test_the_pause_asked_for_follows_the_longest_so_far(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []
    now = 1000.0

    class Asked(SimulatedLink):
        def pause(self, seconds: float) -> None:
            asked.append(seconds)

    env = SwimEnv(Asked(load(None)), load(None), EnvironmentSettings())
    env.reset(seed=1)
    monkeypatch.setattr(time, "monotonic", lambda: now)
    for took in (0.5, 5.0, 1.0, 60.0, 0.0):
        env.pause()
        now += took
        env.resume()
    assert asked == [120.0, 10.0, 20.0, 20.0, 120.0]
    env.pause(300.0)
    assert asked[-1] == 300.0


def test_the_environment_on_a_running_fishd_passes_both_checkers(
    daemon: Daemon, tmp_path: Path
) -> None:
    address = f"ipc://{tmp_path}/agent"
    with Fish(daemon.endpoint) as fish:  # a busy machine may hold the checkers up for many ticks
        fish.set_controller("remote", agent=address, misses=100)
    env = gymnasium.make("fishd/SwimOnDaemon-v0", endpoint=daemon.endpoint, agent=address).unwrapped
    try:
        check_env(env, skip_render_check=True, skip_close_check=True)
        check_for_baselines(env, warn=True)
    finally:
        env.close()


def test_the_environment_on_a_running_fishd_listens_where_it_is_told_to(tmp_path: Path) -> None:
    address = f"ipc://{tmp_path}/agent"
    with running(tmp_path, *sets("lockstep=true")) as daemon:  # it waits for its agent
        env = gymnasium.make("fishd/SwimOnDaemon-v0", endpoint=daemon.endpoint, agent=address)
        try:
            env.reset()
            with Fish(daemon.endpoint) as fish:
                assert fish.status().parameters["agent"] == address
        finally:
            env.close()


def test_without_a_fishd_it_says_where_it_looked(tmp_path: Path) -> None:
    with pytest.raises(NoDaemon, match="control"):
        gymnasium.make("fishd/SwimOnDaemon-v0", endpoint=f"ipc://{tmp_path}/control")


def test_no_policy_learns_from_a_fin_velocity_that_it_will_not_be_shown() -> None:
    with pytest.raises(ConfigError, match="observer is not possible with fin_velocity"):
        gymnasium.make("fishd/Swim-v0", overrides=("estimator.kind=observer",))


def test_power_with_a_price_is_taken_off_the_reward() -> None:
    config, rewards = load(None), []
    for price in (0.0, 0.01):
        link, settings = SimulatedLink(config), EnvironmentSettings(power_price=price)
        env = SwimEnv(link, config, settings)
        env.reset(seed=1)
        rewards.append(env.step(np.array([1.0], np.float32))[1])
        power = link.step(0.42).power
        assert power is not None
        assert power > 0.06
    assert rewards[1] < rewards[0] - 0.3 * 0.01 * 0.06 / env.best_thrust


class Unmetered(SimulatedLink):
    """A fish whose power nobody knows."""

    def step(self, angle: float) -> StepResult:
        return super().step(angle)._replace(power=None)


def test_power_that_is_not_known_can_have_no_price() -> None:
    config = load(None)
    env = SwimEnv(Unmetered(config), config, EnvironmentSettings(power_price=0.01, longest_start=0))
    env.reset(seed=1)
    with pytest.raises(ConfigError, match=r"environment\.power_price: the power of the servo"):
        env.step(np.array([1.0], np.float32))
