"""A camera of this machine: a real `fishd-camera` and linuxpy on an emulated V4L2 device."""

import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rigs.camera_process import V4l2Rig, v4l2_rig
from rigs.processes import wait_until

from fishd.camera.client import CameraClient, CameraLost
from fishd.camera.messages import PublishedFrame


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[V4l2Rig]:
    with v4l2_rig(tmp_path_factory.mktemp("camera"), "v4l2.rate=30") as process:
        yield process


@pytest.fixture
def good(rig: V4l2Rig) -> V4l2Rig:
    """The same process, with a camera in order again."""
    rig.set()
    rig.is_in("streaming")
    return rig


def published(client: CameraClient, number: int) -> list[PublishedFrame]:
    """Return the next frames, a number of them."""
    frames: list[PublishedFrame] = []
    while len(frames) < number:
        if client.poll(5.0) and client.latest:
            frames.append(client.latest)
    return frames


def test_frames_come_with_the_times_of_the_kernel(good: V4l2Rig) -> None:
    with good.client() as client:
        headers = [frame.header for frame in published(client, 10)]
        state = client.status()
    assert all(0.0 < b.time - a.time < 30.0 for a, b in pairwise(headers))
    assert 0.0 < time.monotonic() - headers[-1].time < 30.0
    assert state.limitations == ()
    assert (state.picture_width, state.picture_height, state.width) == (640, 480, 84)
    assert (state.source, state.device) == ("v4l2", "/dev/video7")


def test_a_frame_shows_the_square_in_the_middle_averaged(good: V4l2Rig) -> None:
    with good.client() as client:
        pixels = published(client, 1)[0].pixels
    assert pixels.shape == (84, 84)
    assert np.all(pixels[2:40, 44:82] < 10)  # what is black in the picture
    assert np.all(pixels[44:82, 44:82] > 240)
    assert float(pixels[:, 2:40].std()) < 3.0


@pytest.mark.parametrize("format_", ["YUYV", "GREY"])
def test_other_formats_show_the_same(tmp_path: Path, format_: str) -> None:
    with v4l2_rig(tmp_path, f"v4l2.format={format_}", "picture.rotate=180") as rig:
        with rig.client() as client:
            pixels = published(client, 1)[0].pixels
        assert np.all(pixels[44:82, 2:40] < 10)
        assert np.all(pixels[2:40, 2:40] > 240)


@pytest.mark.parametrize("fault", ["broken", "garbage"])
def test_broken_jpegs_are_counted_and_left_out(good: V4l2Rig, fault: str) -> None:
    before = good.status().broken_frames
    good.set(**{fault: True})
    after = good.until(lambda state: state.broken_frames > before + 3)
    good.set()
    good.until(lambda state: state.seq > after.seq + 3)


def test_a_camera_that_sends_only_broken_frames_is_opened_again(good: V4l2Rig) -> None:
    good.set(broken=True)
    state = good.is_in("stalled")
    assert "/dev/video7 has sent only broken frames for 2 s (" in state.problem
    assert "another cable or port" in state.remedy
    assert (state.rate, state.latency) == (0.0, None)
    # The camera is open again
    good.until(lambda later: later.broken_frames > state.broken_frames + 3)
    assert good.status().state == "stalled"
    good.set()
    good.is_in("streaming")


def test_frames_that_the_kernel_never_got_are_counted(good: V4l2Rig) -> None:
    before = good.status().dropped_frames
    good.set(skip=5)
    good.until(lambda state: state.dropped_frames >= before + 3)


def test_a_client_is_told_that_the_camera_is_unplugged(good: V4l2Rig) -> None:
    with good.client() as client:
        published(client, 2)
        good.set(unplugged=True)
        good.is_in("unplugged")
        client._timeout = 0.5  # limits silence, not the time of an answer
        with pytest.raises(CameraLost, match=r"has been unplugged for \d+ s: /dev/video7: there"):
            for _ in client.frames():
                pass
        good.set()
        good.is_in("streaming")
        assert client.poll(10.0)  # the same client goes on


def test_a_camera_that_stalls_is_opened_anew(good: V4l2Rig) -> None:
    good.set(stalled=True)
    assert "has sent no frame for 2 s" in good.is_in("stalled").problem
    good.set()
    good.is_in("streaming")


@pytest.mark.parametrize(
    ("fault", "problem", "remedy"),
    [
        ({"denied": True}, "this user may not open it", "usermod -aG video"),
        ({"busy": True}, "another program uses it", "close that program"),
        ({"formats": ("YUYV",)}, "does not send MJPG", "that it sends: YUYV"),
        ({"no_video": True}, "", "second device takes no pictures"),
    ],
)
def test_a_camera_that_cannot_be_used_says_why_and_is_tried_again(
    good: V4l2Rig, fault: dict[str, Any], problem: str, remedy: str
) -> None:
    good.set(unplugged=True)
    good.is_in("unplugged")
    good.set(**fault)
    state = good.is_in("unusable")
    assert problem in state.problem
    assert remedy in state.remedy
    good.set()
    good.is_in("streaming")


def test_time_stamps_of_another_clock_are_replaced_by_those_of_arrival(good: V4l2Rig) -> None:
    good.set(realtime_stamps=True)
    state = good.until(lambda state: bool(state.limitations))
    assert "times are those of arrival" in state.limitations[0]
    with good.client() as client:
        header = published(client, 1)[0].header
    assert abs(time.monotonic() - header.time) < 30.0
    good.set()
    good.until(lambda state: not state.limitations)


def test_frames_that_have_waited_in_the_driver_are_dropped_and_counted(good: V4l2Rig) -> None:
    before = good.until(lambda state: not state.limitations)
    with good.client() as client:
        good.set(late=4)
        frames = published(client, 1)
        while frames[-1].header.dropped_frames < before.dropped_frames + 4:
            frames += published(client, 1)
        after = client.status()
    assert (after.session, after.limitations) == (before.session, ())
    assert all(frame.header.available - frame.header.time < 3.0 for frame in frames)
    assert all(a.header.time < b.header.time for a, b in pairwise(frames))


def test_controls_are_set_and_tell_the_exposure(tmp_path: Path) -> None:
    exposure = ("v4l2.controls.auto_exposure=1", "v4l2.controls.exposure_time_absolute=100")
    controls = (*exposure, "v4l2.controls.gain=3")
    with v4l2_rig(tmp_path, *controls, rate=15.0) as rig:
        state = rig.is_in("streaming")
        assert state.exposure == pytest.approx(0.01)
        assert state.limitations == ("it takes 15 frames a second, not 30",)


@pytest.mark.parametrize(
    ("control", "problem"),
    [
        ("gian=3", "v4l2.controls.gian: there is none; did you mean 'gain'?"),
        ("gain=300", "v4l2.controls.gain: 300 is not valid: 0 to 100 is needed"),
        ("exposure_time_absolute=9", "the camera refuses 9: Permission denied"),
    ],
)
def test_a_control_that_cannot_be_set_is_named(tmp_path: Path, control: str, problem: str) -> None:
    with v4l2_rig(tmp_path, f"v4l2.controls.{control}") as rig:
        assert problem in rig.is_in("unusable").problem


@pytest.mark.parametrize("end", [False, True])
def test_its_time_is_the_middle_of_the_exposure(tmp_path: Path, end: bool) -> None:
    controls = ("v4l2.controls.auto_exposure=1", "v4l2.controls.exposure_time_absolute=100")
    with (
        v4l2_rig(tmp_path, *controls, "v4l2.delay=0.1", end_of_frame=end) as rig,
        rig.client() as client,
    ):
        # The emulation says that an exposure has ended 5 ms before its frame is there.
        least, delays = 0.1 + 0.005 + 0.005, list[float]()

        def has_come_at_once() -> bool:
            delays.extend(f.header.available - f.header.time for f in published(client, 5))
            return min(delays) < least + 0.05

        wait_until(has_come_at_once)
    assert min(delays) >= least
