"""Messages between fishd and its gateway."""

import pytest
import zmq
from hypothesis import given
from hypothesis import strategies as st

from fishd.daemon.gateway import link
from fishd.daemon.gateway.server import GatewayServer


@given(topic=st.sampled_from([b"tick", b"event", b"status"]), payload=st.binary())
def test_a_published_message_arrives_as_its_two_frames(topic: bytes, payload: bytes) -> None:
    assert link.split_frames(link.join_frames(topic, payload)) == [topic, payload]


@given(number=st.integers(0, 2**64 - 1), payload=st.binary())
def test_a_request_arrives_with_its_number(number: int, payload: bytes) -> None:
    assert link.number_and_payload(link.request(number, payload)) == (number, payload)


@pytest.mark.parametrize(
    "length",
    [0, 1, link.MAX_MESSAGE_BYTES - 10, link.MAX_MESSAGE_BYTES, 3 * link.MAX_MESSAGE_BYTES],
)
def test_replies_of_any_length_travel_in_parts_and_may_be_mixed(length: int) -> None:
    long, short = bytes(length), b"short"
    parts = list(link.reply(1, long))
    assert all(len(part) <= link.MAX_MESSAGE_BYTES for part in parts)
    replies = link.Replies()
    assert all(replies.take(part) is None for part in parts[:-1])
    assert [replies.take(part) for part in link.reply(2, short)] == [(2, short)]
    assert replies.take(parts[-1]) == (1, long)


def test_a_link_never_blocks_its_sender() -> None:
    ours, theirs = link.pair()

    def fill() -> None:
        for _ in range(10_000):
            ours.send(bytes(1000))

    with ours, theirs, pytest.raises(BlockingIOError):
        fill()


@pytest.mark.parametrize(
    ("messages", "wanted"),
    [
        ([b"\x01tick"], True),
        ([b"\x01"], True),
        ([b"\x01ti"], True),
        ([b"\x01event", b"\x01ticks", b"", b"\x05tick", b"tick"], False),
        ([b"\x01tick", b"\x01", b"\x00tick"], True),
        ([b"\x01tick", b"\x01", b"\x00", b"\x00tick"], False),
    ],
)
def test_fishd_sends_ticks_only_while_a_subscription_matches_them(
    messages: list[bytes], wanted: bool
) -> None:
    ours, theirs = link.pair()
    with ours, theirs, zmq.Context() as context, context.socket(zmq.PAIR) as subscribers:
        subscribers.bind("inproc://subscribers")
        with context.socket(zmq.PAIR) as telemetry:
            telemetry.connect("inproc://subscribers")
            for message in messages:
                subscribers.send(message)
            server = GatewayServer(theirs)
            server._take_subscriptions(telemetry)
            server._request_ticks()
            server._request_ticks()  # it is said once
            server._context.destroy(linger=0)
        said = [ours.recv(100)] if wanted else []
        assert said == ([link.TICKS + b"\x01"] if wanted else [])
        with pytest.raises(BlockingIOError):
            ours.recv(100)
