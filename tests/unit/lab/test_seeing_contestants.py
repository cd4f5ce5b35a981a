"""Policies that see pictures in comparisons: in simulation, and on the fish of a running fishd."""

from pathlib import Path

import pytest
from msgspec.structs import replace
from rigs.pictures import WEB
from rigs.policy_files import seeing_card, velocity_follower, write

from fishd.camera.simulated import DEFAULT
from fishd.config import Config, load
from fishd.core.errors import ParameterError
from fishd.lab.compare import compare
from fishd.lab.compare.contestants import default_contestants, parse, refusal


@pytest.fixture
def eye(tmp_path: Path) -> str:
    return str(write(tmp_path, velocity_follower(), "eye"))


def test_a_policy_that_sees_is_a_contestant_like_any_other(eye: str) -> None:
    standings, traces = compare(Config(), ["swing", eye], seconds=20.0, settle=5.0)
    swing, seen = standings
    assert (seen.contestant, seen.controller) == (eye, "ppo")
    assert seen.parameters == {"policy": eye}
    assert 0.4 < seen.relative_thrust < swing.relative_thrust
    assert not seen.fallbacks
    assert len(traces) == 2


def test_each_run_is_seen_in_other_light_and_the_same_runs_again_are_the_same(eye: str) -> None:
    brief = {"seconds": 10.0, "settle": 5.0, "runs": 2}
    first, again = (compare(Config(), [eye], **brief)[0][0].thrusts for _ in range(2))
    assert first == again
    assert first[0] != first[1]


def test_what_the_camera_shows_decides(eye: str) -> None:
    def thrust(camera: object) -> float:
        return compare(Config(), [eye], 10.0, 5.0, camera=camera)[0][0].thrust  # type: ignore[arg-type]

    assert thrust(WEB) < 0.5 * thrust(DEFAULT)
    assert thrust(replace(DEFAULT, contrast=1.0, noise=0.0)) < 0.5 * thrust(DEFAULT)


def test_one_for_another_robot_is_refused_before_anything_swims(tmp_path: Path) -> None:
    content = velocity_follower(about=seeing_card(tick=0.02))
    quick = parse(str(write(tmp_path, content, "quick")))
    refused = refusal(Config(), quick)
    assert isinstance(refused, ParameterError)
    assert "trained at a tick of 20 ms, this robot's is 50 ms" in str(refused)


def test_named_policies_swim_by_default(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, velocity_follower(), "eye")
    monkeypatch.setenv("FISHD_POLICIES", str(tmp_path))
    assert "eye" in [contestant.label for contestant in default_contestants(Config())]


@pytest.mark.slow
def test_it_swims_on_a_virtual_pi_in_virtual_time_too(tmp_path: Path, eye: str) -> None:
    config = load(None, ["robot=virtual-pi", f"state_folder={tmp_path}"])
    standing = compare(config, [eye], seconds=10.0, settle=5.0)[0][0]
    assert standing.relative_thrust > 0.3
