"""Eyes: what they see of a tail that babbles, and what they do not."""

from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

pytest.importorskip("stable_baselines3", reason="install the extra 'learn'")

from fishd.camera.axis import NoMotion
from fishd.camera.simulated.settings import DEFAULT, WEB, SimulatedCameraSettings
from fishd.config import Config
from fishd.core.camera_frames import Stack, StackSettings
from fishd.learning.env.environment import SwimEnv
from fishd.learning.env.link import StepResult
from fishd.learning.env.simulated_link import Camera, SimulatedLink
from fishd.learning.eyes.base import Eye
from fishd.learning.eyes.making import make_eye, random_angles
from fishd.learning.settings import EnvironmentSettings, TrainingSettings, VisionSettings

CONFIG = Config()
EYES = ["modes", "cnn", "nature"]
TICKS = 256


def eye_of(kind: str, **settings: object) -> Eye:
    camera = VisionSettings(eye=kind, **settings)
    eye = make_eye(TrainingSettings(see="camera", camera=camera))
    assert eye
    return eye


def swum(
    rig: SimulatedCameraSettings, angles: NDArray[np.float64] | None = None
) -> tuple[list[Stack], NDArray[np.float64], NDArray[np.float64]]:
    """Stacks and fin angles of a fish that babbles, and what it was told."""
    if angles is None:
        angles = random_angles(0, TICKS, CONFIG.amplitude_limit)
    eye = eye_of("nature")
    link = SimulatedLink(CONFIG, camera=Camera(rig, StackSettings()))
    env = SwimEnv(
        link, CONFIG, EnvironmentSettings(observation=("instruction_angle",), longest_start=0), eye
    )
    env.reset(seed=0)
    stacks, fins = [], []
    for angle in angles:
        env.advance(float(angle))
        assert env.stack
        stacks.append(env.stack)
        fins.append(link._loop.robot.truth().alpha)
    return stacks, np.array(fins), angles


class Waiting(SimulatedLink):
    """Knows whether it is in a pause."""

    waits = False

    def step(self, angle: float) -> StepResult:
        self.waits = False
        return super().step(angle)

    def pause(self, seconds: float) -> None:
        self.waits = True


def test_the_fish_waits_while_its_eye_finds_out_what_it_has_seen_and_afterwards(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    eye = eye_of("nature")
    link = Waiting(CONFIG, camera=Camera(DEFAULT, StackSettings()))
    env = SwimEnv(link, CONFIG, EnvironmentSettings(longest_start=0), eye)
    waited: list[bool] = []
    monkeypatch.setattr(eye, "fit", lambda frames, angles: waited.append(link.waits))
    env.reset(seed=0)
    assert env.babble(0, 4)
    assert waited == [True]
    assert link.waits


def fitted(kind: str, rig: SimulatedCameraSettings = DEFAULT, **settings: object) -> Eye:
    stacks, _, angles = swum(rig)
    eye = eye_of(kind, **settings)
    eye.fit(np.stack([stack[0] for stack in stacks]), angles)
    return eye


def mirrored(stack: Stack) -> Stack:
    return tuple(frame[::-1] for frame in stack)


@pytest.mark.parametrize("rig", [DEFAULT, WEB])
def test_modes_tell_the_fin_angle_whatever_the_light(rig: SimulatedCameraSettings) -> None:
    eye = fitted("modes", rig)
    told = random_angles(1, 300, CONFIG.amplitude_limit)
    stacks, fins, _ = swum(replace(rig, seed=7, light_drift=0.2), told)
    seen = np.stack([eye.see(stack) for stack in stacks])[:, :4]
    fit = np.linalg.lstsq(seen, fins, rcond=None)[0]
    left = (fins - seen @ fit).std() / fins.std()
    assert left < (0.35 if rig is DEFAULT else 0.75)  # the picture is 30, or 50 to 90 ms, old


@pytest.mark.parametrize("kind", ["modes", "cnn"])
def test_what_an_eye_gives_for_a_mirrored_picture_is_mirrored(kind: str) -> None:
    rig = replace(DEFAULT, noise=0.0)
    eye = fitted(kind, rig)
    stack = swum(rig)[0][-1]
    one, other = eye.see(stack), eye.see(mirrored(stack))
    if eye.shape:
        image = other.reshape(eye.shape)[:, ::-1]
        assert np.abs(one.reshape(eye.shape) - image).max() < 0.15 * np.abs(one).max()
    else:
        assert np.abs(one + other).max() < 0.15 * np.abs(one).max()


def test_an_eye_that_looks_for_the_axis_finds_it_where_the_camera_is_off() -> None:
    off = replace(DEFAULT, noise=0.0, off_axis=4.0)
    stack = swum(off)[0][-1]
    centred = swum(replace(off, off_axis=0.0))[0][-1]
    wanted = fitted("cnn", replace(off, off_axis=0.0)).see(centred)
    aligned = fitted("cnn", off).see(stack)
    blind = fitted("cnn", off, align=False).see(stack)
    assert np.abs(aligned - wanted).mean() < 0.3 * np.abs(blind - wanted).mean()


@pytest.mark.parametrize("kind", ["modes", "cnn"])
def test_an_eye_does_not_see_how_bright_the_light_is(kind: str) -> None:
    eye = fitted(kind)
    stack = swum(DEFAULT)[0][-1]
    darker = tuple((0.7 * frame).astype(np.uint8) for frame in stack)
    assert np.abs(eye.see(stack) - eye.see(darker)).max() < 0.2


@pytest.mark.parametrize("kind", ["modes", "cnn"])
def test_an_eye_cannot_be_fitted_to_a_fish_that_rests(kind: str) -> None:
    stacks, _, angles = swum(DEFAULT, np.zeros(TICKS))
    with pytest.raises(NoMotion, match="let the fish swim"):
        eye_of(kind).fit(np.stack([stack[0] for stack in stacks]), angles)


@pytest.mark.parametrize("kind", EYES)
def test_an_eye_with_the_constants_of_another_sees_the_same(kind: str) -> None:
    eye, other = fitted(kind), eye_of(kind)
    other.restore(eye.constants)
    stack = swum(DEFAULT)[0][-1]
    assert np.array_equal(eye.see(stack), other.see(stack))


@pytest.mark.parametrize(
    "change",
    [lambda kept: kept.pop("zero"), lambda kept: kept.update(more=np.zeros(3))],
)
def test_constants_of_another_kind_of_eye_are_refused(
    change: Callable[[dict[str, object]], None],
) -> None:
    kept: dict[str, object] = {"patterns": np.zeros((4, 84 * 84)), "zero": np.zeros(4)}
    change(kept)
    with pytest.raises(ValueError, match="constants of shapes"):
        eye_of("modes").restore(kept)


def test_the_babble_is_the_same_for_the_same_seed_and_within_the_limit() -> None:
    one, other = (random_angles(3, 501, 0.42) for _ in range(2))
    assert np.array_equal(one, other)
    assert 0.3 < np.abs(one).max() <= 0.42
    assert not np.array_equal(one, random_angles(4, 501, 0.42))
