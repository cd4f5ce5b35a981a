"""Survey of contestants on many fish, and its verb `fishctl learn evaluate`."""

import json
from pathlib import Path

import pytest
from msgspec.structs import replace
from rigs.policy_files import write
from rigs.processes import fishctl

from fishd.config import load
from fishd.lab.compare.contestants import Contestant, parse
from fishd.lab.compare.survey import CHANGES, OtherFish, harsh, harsh_fish, mild, survey
from fishd.lab.simulation import simulate

BRIEF = ("--seconds", "8", "--settle", "3")


def test_each_fish_is_swum_as_by_itself() -> None:
    fish = (OtherFish("slow", ("plant.omega0=8",)), harsh(7))
    configs = [(other_fish, load(None, other_fish.overrides)) for other_fish in fish]
    swing, square = survey(configs, [parse("swing:C=0.5"), parse("square:frequency=1.7")], 8.0, 3.0)
    assert [result.fish for result in square.fish] == ["slow", "harsh 7"]
    for (_, config), result in zip(configs, swing.fish, strict=True):
        alone = simulate(config, "swing", {"C": 0.5}, 8.0, 3.0)
        assert (result.relative_thrust, result.thrust) == (alone.relative_thrust, alone.mean_thrust)
    assert swing.worst.relative_thrust <= swing.median


def test_it_tells_who_shook_the_servo_and_who_lost_command(tmp_path: Path) -> None:
    policy = Contestant("flip", "ppo", {"policy": str(write(tmp_path))})
    free, limited = CHANGES[0], OtherFish("limited", ())
    configs = [(free, load(None, ["chatter.dwell=0"])), (limited, load(None))]
    (flip,) = survey(configs, [policy], 8.0, 3.0)
    shaken, held = flip.fish
    assert (shaken.longest_chatter_s, shaken.fallback) == (pytest.approx(8.0, abs=0.2), None)
    assert held.longest_chatter_s == 0.0
    assert held.fallback.startswith("ppo gave up")


def test_the_harsh_fish_are_twenty_and_always_the_same() -> None:
    fish = harsh_fish()
    assert len({other_fish.overrides for other_fish in fish}) == 20
    assert fish == harsh_fish()
    assert 8.0 <= load(None, fish[3].overrides).plant.omega0 <= 18.0


def test_mild_fish_are_as_random_as_harsh_ones_and_their_rigs_are_clean() -> None:
    fish = [load(None, mild(seed).overrides) for seed in range(20)]
    default = load(None)
    for config in fish:
        assert 8.0 <= config.plant.omega0 <= 18.0
        assert 0.0 <= config.plant.servo_delay <= 0.02
        assert config.plant.backlash == config.plant.servo_dead_zone == 0.0
        assert replace(config.simulation, seed=0) == default.simulation
    assert len({config.plant for config in fish}) == 20
    assert mild(3) == mild(3)


def test_the_verb_has_a_column_for_each_contestant(tmp_path: Path) -> None:
    words = ("swing", "square:frequency=1.7", "--variation", "changes", *BRIEF)
    done = fishctl("learn", "evaluate", *words, "--plot", str(tmp_path / "survey.png"))
    assert (tmp_path / "survey.png").read_bytes().startswith(b"\x89PNG")
    assert (done.returncode, done.stderr) == (0, "")
    head, *rows = done.stdout.splitlines()
    assert head.split() == ["fish", "swing", "square:frequency=1.7"]
    assert [row.rpartition("%")[0] != "" for row in rows[: len(CHANGES)]] == [True] * len(CHANGES)
    assert rows[-2].split() == ["another", "took", "over", "0", "0"]


@pytest.mark.slow
def test_the_verb_tells_programs_every_fish() -> None:
    done = fishctl("learn", "evaluate", "hold", "--seconds", "2", "--settle", "1", "--json")
    (hold,) = json.loads(done.stdout)
    assert hold["contestant"] == "hold"
    assert [row["fish"] for row in hold["fish"][-2:]] == ["harsh 318", "harsh 319"]
    assert "plant.servo_delay=0.02" in hold["fish"][3]["overrides"]
    assert len(hold["fish"]) == len(CHANGES) + 20
