"""Policy that runs outside of fishd's loop, with and without frames."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from rigs.harness import observe
from rigs.policy_files import FLIP, of_pixels, seeing_card, write

from fishd.controllers.base import Limits
from fishd.controllers.policy.runtime import HOLD_TIME_S, Pilot
from fishd.core.camera_frames import Stack
from fishd.core.errors import ControllerFault, PolicyError

LIMITS = Limits(0.42, 0.05, dwell=0.0)
TICK = 0.05


def stack(grey: int, size: int = 32) -> Stack:
    return tuple(np.full((size, size), grey, np.uint8) for _ in range(2))


@pytest.fixture
def brightness(tmp_path: Path) -> str:
    """Return a policy whose angle follows the brightness of the newest frame, and is 0 at 100."""
    about = seeing_card(("instruction_angle", 0.42))
    weights = np.zeros((2, 32, 32))
    weights[0] = 1.0 / 32**2 / 100.0
    return str(write(tmp_path, of_pixels(weights, about, 0.0), "brightness"))


def test_the_angle_follows_the_frames(brightness: str) -> None:
    pilot = Pilot(brightness, LIMITS)
    assert pilot.angle(observe(), stack(50)) == pytest.approx(0.21, abs=1e-6)
    assert pilot.angle(observe(), stack(250)) == pytest.approx(0.42)


def test_without_frames_it_holds_its_angle_and_then_goes_to_neutral(brightness: str) -> None:
    pilot = Pilot(brightness, LIMITS)
    held = pilot.angle(observe(), stack(50))
    blind = [pilot.angle(observe()) for _ in range(8)]
    ticks = round(HOLD_TIME_S / TICK)
    assert blind == [held] * ticks + [0.0] * (8 - ticks)
    assert pilot.waits
    assert pilot.blind == pytest.approx(8 * TICK)
    assert pilot.angle(observe(), stack(50)) == held
    assert not pilot.waits
    assert pilot.blind == 0.0


def test_it_is_at_neutral_until_the_first_frames_come(brightness: str) -> None:
    pilot = Pilot(brightness, LIMITS)
    assert [pilot.angle(observe(angle=0.42)) for _ in range(3)] == [0.0] * 3


def test_a_policy_of_forces_needs_no_frames(tmp_path: Path) -> None:
    pilot = Pilot(str(write(tmp_path, FLIP)), LIMITS)
    assert pilot.angle(observe(angle=0.42)) == pytest.approx(-0.42)
    assert pilot.angle(observe(angle=-0.42)) == pytest.approx(0.42)
    assert not pilot.waits


def test_it_reverses_no_sooner_than_ppo_would(tmp_path: Path) -> None:
    pilot = Pilot(str(write(tmp_path, FLIP)), replace(LIMITS, dwell=0.2))
    angle = 0.42
    given = [angle := pilot.angle(observe(angle)) for _ in range(12)]
    assert given == pytest.approx([0.42] * 3 + [-0.42] * 4 + [0.42] * 4 + [-0.42])

    def insist(angle: float) -> None:
        for _ in range(40):
            angle = pilot.angle(observe(angle))

    with pytest.raises(ControllerFault, match="wanted to reverse sooner than") as caught:
        insist(angle)
    assert caught.value.successor[0] == "swing"


def test_frames_of_another_size_are_refused(brightness: str) -> None:
    with pytest.raises(PolicyError, match=r"needs 2 frames of 32 x 32 pixels, but got .*\[\(84"):
        Pilot(brightness, LIMITS).angle(observe(), stack(50, size=84))
