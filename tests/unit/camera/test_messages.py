"""Messages of a camera: valid ones are decoded, others are refused in one line."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from fishd.camera import messages
from fishd.camera.messages import BadMessage, FrameHeader, PublishedFrame, TailMessage, Until
from fishd.core.camera_frames import Pixels

PIXELS = np.arange(12, dtype=np.uint8).reshape(3, 4)
HEADER = FrameHeader(session="s", seq=7, time=1.25, available=1.5, width=4, height=3)
TAIL = TailMessage(
    session="s", seq=7, time=1.25, alpha=None, zero=0.01, reason="why", midline=((1.5, 2.0),)
)


@pytest.mark.parametrize(
    "pixels",
    [PIXELS, np.arange(48, dtype=np.uint8).reshape(6, 8)[::2, ::2]],
    ids=["a frame", "a part of a larger picture"],
)
def test_it_is_read_back_as_it_was_sent(pixels: Pixels) -> None:
    message = messages.decode(messages.encode(HEADER, pixels.tobytes()))
    assert message.header == HEADER
    assert np.array_equal(message.pixels, pixels)


def test_a_fin_angle_is_read_back_as_it_was_sent() -> None:
    assert messages.decode(messages.encode(TAIL)) == TAIL


def test_no_topic_begins_like_another() -> None:
    topics = [messages.FRAME, messages.VIEW, messages.TAIL, messages.STATE, messages.UNTIL]
    assert not [(a, b) for a in topics for b in topics if a != b and a.startswith(b)]


@pytest.mark.parametrize(
    ("parts", "why"),
    [
        ([b"tick", b"{}"], "topic b'tick' is not a topic of a camera"),
        ([b"frame", b"{}"], "a message of topic frame has 3 parts, not 2"),
        ([b"until", b"nonsense"], "a message of topic until that cannot be read"),
        ([b"until", b'{"v":3}'], "in version 3; version 2 is needed"),
        (
            [*messages.encode(HEADER, PIXELS.tobytes())[:2], b"short"],
            "4 x 3 px has 12 bytes, not 5",
        ),
        ([b"frame", b'{"v":2,"width":100000}', b""], "cannot be read"),
        (
            messages.encode(replace(HEADER, time=1e300, available=1e300), PIXELS.tobytes()),
            "`$.time`",
        ),
        (messages.encode(replace(HEADER, available=-1e300), PIXELS.tobytes()), "`$.available`"),
        (
            messages.encode(replace(HEADER, time=1e6), PIXELS.tobytes()),
            "999998 s before its exposure",
        ),
        (messages.encode(Until(session="s", until=1e300)), "`$.until`"),
        (messages.encode(replace(TAIL, time=1e300)), "`$.time`"),
    ],
)
def test_what_is_no_message_is_refused(parts: list[bytes], why: str) -> None:
    with pytest.raises(BadMessage) as caught:
        messages.decode(parts)
    assert why in str(caught.value)
    assert "\n" not in str(caught.value)


@given(st.lists(st.binary(max_size=100), min_size=1, max_size=4))
def test_anything_is_a_message_or_refused(parts: list[bytes]) -> None:
    for topic in (parts[0], b"frame", b"view", b"tail", b"state", b"until"):
        with pytest.raises(BadMessage):
            messages.decode([topic, *parts[1:]])


def test_a_frame_whose_time_its_settings_moved_is_still_one() -> None:
    moved = replace(HEADER, time=HEADER.available + 1.0)
    message = messages.decode(messages.encode(moved, PIXELS.tobytes()))
    assert isinstance(message, PublishedFrame)
