"""Feature extractors that are fitted to a tail with random motion."""

from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace
from numpy.typing import NDArray

pytest.importorskip("stable_baselines3", reason="install the extra 'learn'")

from rigs.pictures import WEB

from fishd.camera.axis import NoMotion
from fishd.camera.simulated import DEFAULT, SimulatedCameraSettings
from fishd.config import Config
from fishd.core.camera_frames import Stack, StackSettings
from fishd.learning.env.environment import SwimEnv
from fishd.learning.extractors import FeatureExtractor, make_extractor, random_angles
from fishd.learning.links.link import StepResult
from fishd.learning.links.simulated_link import Camera, SimulatedLink
from fishd.learning.settings import EnvironmentSettings, TrainingSettings, VisionSettings

CONFIG = Config()
EYES = ["modes", "cnn", "nature"]
TICKS = 256


def extractor_of(kind: str, **settings: object) -> FeatureExtractor:
    camera = VisionSettings(feature_extractor=kind, **settings)
    return make_extractor(TrainingSettings(see="camera", camera=camera))


def swim_with(
    rig: SimulatedCameraSettings, angles: NDArray[np.float64] | None = None
) -> tuple[list[Stack], NDArray[np.float64], NDArray[np.float64]]:
    """Return stacks, fin angles and commands of a fish with random motion."""
    if angles is None:
        angles = random_angles(0, TICKS, CONFIG.amplitude_limit)
    extractor = extractor_of("nature")
    link = SimulatedLink(CONFIG, camera=Camera(rig, StackSettings()))
    settings = EnvironmentSettings(observation=("instruction_angle",), longest_start=0)
    env = SwimEnv(link, CONFIG, settings, extractor)
    env.reset(seed=0)
    stacks, fins = [], []
    for angle in angles:
        env.advance(float(angle))
        stacks.append(env.stack)
        fins.append(link._swimming().loop.robot.truth().alpha)
    return stacks, np.array(fins), angles


class Waiting(SimulatedLink):
    """A link that knows whether it is in a pause."""

    waits = False

    def step(self, angle: float) -> StepResult:
        self.waits = False
        return super().step(angle)

    def pause(self, seconds: float) -> None:
        self.waits = True


def test_the_fish_waits_while_its_eye_is_fitted_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    extractor = extractor_of("nature")
    link = Waiting(CONFIG, camera=Camera(DEFAULT, StackSettings()))
    env = SwimEnv(link, CONFIG, EnvironmentSettings(longest_start=0), extractor)
    waits: list[bool] = []
    monkeypatch.setattr(extractor, "fit", lambda frames, angles: waits.append(link.waits))
    env.reset(seed=0)
    assert env.excite_randomly(0, 4)
    assert waits == [True]
    assert link.waits


def fitted(
    kind: str, rig: SimulatedCameraSettings = DEFAULT, **settings: object
) -> FeatureExtractor:
    stacks, _, angles = swim_with(rig)
    extractor = extractor_of(kind, **settings)
    extractor.fit(np.stack([stack[0] for stack in stacks]), angles)
    return extractor


def mirrored(stack: Stack) -> Stack:
    return tuple(frame[::-1] for frame in stack)


@pytest.mark.parametrize("rig", [DEFAULT, WEB])
def test_modes_contain_the_fin_angle_whatever_the_light(rig: SimulatedCameraSettings) -> None:
    extractor = fitted("modes", rig)
    angles = random_angles(1, 300, CONFIG.amplitude_limit)
    stacks, fins, _ = swim_with(replace(rig, seed=7, light_drift=0.2), angles)
    seen = np.stack([extractor.see(stack) for stack in stacks])[:, :4]
    fit = np.linalg.lstsq(seen, fins, rcond=None)[0]
    unexplained = (fins - seen @ fit).std() / fins.std()
    # Pictures are 30 ms, or 50 to 90 ms, old
    assert unexplained < (0.35 if rig is DEFAULT else 0.75)


@pytest.mark.parametrize("kind", ["modes", "cnn"])
def test_the_output_of_an_eye_for_a_mirrored_picture_is_mirrored(kind: str) -> None:
    rig = replace(DEFAULT, noise=0.0)
    extractor = fitted(kind, rig)
    stack = swim_with(rig)[0][-1]
    output, opposite = extractor.see(stack), extractor.see(mirrored(stack))
    if extractor.shape:
        image = opposite.reshape(extractor.shape)[:, ::-1]
        assert np.abs(output.reshape(extractor.shape) - image).max() < 0.15 * np.abs(output).max()
    else:
        assert np.abs(output + opposite).max() < 0.15 * np.abs(output).max()


def test_an_eye_with_align_detects_the_axis_of_a_camera_off_centre() -> None:
    off = replace(DEFAULT, noise=0.0, off_axis=4.0)
    stack = swim_with(off)[0][-1]
    centred = swim_with(replace(off, off_axis=0.0))[0][-1]
    expected = fitted("cnn", replace(off, off_axis=0.0)).see(centred)
    aligned = fitted("cnn", off).see(stack)
    unaligned = fitted("cnn", off, align=False).see(stack)
    assert np.abs(aligned - expected).mean() < 0.3 * np.abs(unaligned - expected).mean()


@pytest.mark.parametrize("kind", ["modes", "cnn"])
def test_the_output_of_an_eye_does_not_depend_on_the_brightness(kind: str) -> None:
    extractor = fitted(kind)
    stack = swim_with(DEFAULT)[0][-1]
    darker = tuple((0.7 * frame).astype(np.uint8) for frame in stack)
    assert np.abs(extractor.see(stack) - extractor.see(darker)).max() < 0.2


@pytest.mark.parametrize("kind", ["modes", "cnn"])
def test_an_eye_cannot_be_fitted_to_a_fish_that_rests(kind: str) -> None:
    stacks, _, angles = swim_with(DEFAULT, np.zeros(TICKS))
    with pytest.raises(NoMotion, match="let the fish swim"):
        extractor_of(kind).fit(np.stack([stack[0] for stack in stacks]), angles)


@pytest.mark.parametrize("kind", EYES)
def test_an_eye_with_the_constants_of_another_sees_the_same(kind: str) -> None:
    extractor, other = fitted(kind), extractor_of(kind)
    other.restore(extractor.constants)
    stack = swim_with(DEFAULT)[0][-1]
    assert np.array_equal(extractor.see(stack), other.see(stack))


@pytest.mark.parametrize(
    "change",
    [lambda constants: constants.pop("zero"), lambda constants: constants.update(more=np.zeros(3))],
)
def test_constants_of_another_eye_are_refused(change: Callable[[dict[str, object]], None]) -> None:
    constants: dict[str, object] = {"patterns": np.zeros((4, 84 * 84)), "zero": np.zeros(4)}
    change(constants)
    with pytest.raises(ValueError, match="constants of shapes"):
        extractor_of("modes").restore(constants)


def test_the_babble_is_the_same_for_the_same_seed_and_within_the_limit() -> None:
    first, second = (random_angles(3, 501, 0.42) for _ in range(2))
    assert np.array_equal(first, second)
    assert 0.3 < np.abs(first).max() <= 0.42
    assert not np.array_equal(first, random_angles(4, 501, 0.42))
