"""A policy that would shake the servo: held back, and replaced by `swing` or a fault."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from rigs.harness import Rig
from rigs.policy_files import write

from fishd.config import load
from fishd.controllers.swing import Swing
from fishd.core.signals import Tick
from fishd.lab.simulation import simulate
from fishd.lab.simulation.virtual_run import KeepingPublisher

HARSH = {
    "slack": ("plant.cable_slack=0.2",),
    "reaction": ("plant.servo_reaction=-0.002",),
    "all of them": (
        "plant.servo_delay=0.03",
        "plant.backlash=0.05",
        "plant.servo_dead_zone=0.05",
        "plant.servo_reaction=0.001",
    ),
}
NOISY = ("simulation.noise=1e-3", "simulation.offset_y=5e-3")


def flipping(tmp_path: Path, *overrides: str) -> Rig:
    """A loop in which a policy is active that wants to reverse in every tick."""
    return Rig(*overrides).start("ppo", policy=str(write(tmp_path)))


def longest_chatter(ticks: list[Tick]) -> float:
    """The longest stretch of reversals in consecutive ticks [s]."""
    run = longest = 0
    for before, now in pairwise(ticks):
        run = run + 1 if before.phi_c * now.phi_c < 0.0 else 0
        longest = max(longest, run)
    return longest * 0.05


def test_chatter_gives_swing_command_in_two_seconds(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rig = flipping(tmp_path)
    ticks = rig.run_for(6.0)
    changed = [tick.controller for tick in ticks].index("swing")
    assert changed == 39
    assert {tick.controller for tick in ticks[changed:]} == {"swing"}
    assert {tick.mode for tick in ticks} == {"running"}
    assert ticks[changed].phi_c == ticks[changed - 1].phi_c  # the angle does not jump
    (event,) = (event for event in rig.recorder.events if event.kind == "fallback")
    assert (event.level, event.data["controller"], event.data["before"], event.data["code"]) == (
        "warning",
        "swing",
        "ppo",
        "chatter",
    )
    assert event.message.startswith("swing takes over with C=0.6, amplitude=0.42 rad, ")
    assert "ppo gave up: in 30 of the last 40 ticks it wanted to reverse sooner" in event.message
    assert event.message in caplog.text
    assert rig.loop.active.fallback.code == "chatter"
    seen = rig.loop.perception.observation
    assert seen.frequency == pytest.approx(1.7, abs=0.2)  # the fish swims


def test_it_is_a_fault_where_that_is_configured(tmp_path: Path) -> None:
    rig = flipping(tmp_path, "chatter.fallback=fault")
    rig.run_for(3.0)
    assert (rig.mode, rig.reason, rig.loop.active.name) == ("fault", "chatter", "hold")
    assert rig.loop.supervisor.reason.message.startswith("controller ppo gave up: in 30 of the ")


def test_patience_and_dwell_are_those_of_the_configuration(tmp_path: Path) -> None:
    rig = flipping(tmp_path, "chatter.patience=1", "chatter.dwell=0.1")
    ticks = rig.run(25)
    assert [tick.phi_c for tick in ticks[:4]] == [0.42, 0.42, -0.42, -0.42]
    assert [tick.controller for tick in ticks].index("swing") == 19


def test_a_policy_that_is_set_again_starts_anew(tmp_path: Path) -> None:
    rig = flipping(tmp_path)
    rig.run_for(5.0)
    assert rig.loop.active.name == "swing"
    rig.start("ppo", policy=str(write(tmp_path)))
    assert {tick.controller for tick in rig.run_for(1.9)} == {"ppo"}
    assert rig.loop.active.fallback is None
    assert rig.run_for(0.2)[-1].controller == "swing"
    rig.loop.stop()
    assert rig.loop.active.fallback is None


def test_a_take_over_builds_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = flipping(tmp_path)

    def never(*args: Any) -> None:
        raise AssertionError("a controller was built in a tick")

    monkeypatch.setattr(Swing, "__init__", never)
    rig.run_for(3.0)
    assert (rig.mode, rig.loop.active.name) == ("running", "swing")


def test_a_policy_keeps_to_the_dwell(tmp_path: Path) -> None:
    rig = flipping(tmp_path)
    assert [tick.phi_c for tick in rig.run(12)] == [0.42] * 4 + [-0.42] * 4 + [0.42] * 4


def test_a_policy_takes_over_as_if_the_tail_had_reversed_just_then(tmp_path: Path) -> None:
    rig = Rig().start("hold", angle=0.3)
    rig.run(10)
    rig.start("ppo", policy=str(write(tmp_path)))
    assert [tick.phi_c for tick in rig.run(4)] == [0.3] * 3 + [-0.42]


@pytest.mark.parametrize("name", ["swing", "square"])
def test_controllers_that_know_when_to_reverse_are_not_limited(name: str) -> None:
    parameters = {"square": {"frequency": 4.0}, "swing": {"C": 1.0}}[name]
    commands = []
    for dwell in (0.0, 2.0):
        rig = Rig(*NOISY, f"chatter.dwell={dwell}").start(name, **parameters)
        commands.append([tick.phi_c for tick in rig.run_for(10.0)])
    assert commands[0] == commands[1]


@pytest.mark.slow
@pytest.mark.parametrize("fish", HARSH.values(), ids=HARSH)
def test_the_shipped_policy_does_not_shake_the_servo_of_a_harsh_fish(fish: tuple[str, ...]) -> None:
    config, publisher = load(None, [*NOISY, *fish]), KeepingPublisher()
    report = simulate(config, "ppo", {"policy": "default-fish"}, 40.0, publisher=publisher)
    assert longest_chatter(publisher.ticks) <= 1.0
    assert report.relative_thrust > 0.95
    assert report.fallback is None
