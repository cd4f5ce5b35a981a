"""A policy file that would become a hundred times as long in memory is refused before it does."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fishd.controllers.policy import library, size_check
from fishd.controllers.policy.file import LARGEST, parse
from fishd.core.errors import PolicyError


def field(number: int, content: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(content)) + content


def varint(number: int) -> bytes:
    found = b""
    while number > 0x7F:
        found += bytes([number & 0x7F | 0x80])
        number >>= 7
    return found + bytes([number])


HEAD = b"\x08\x07" + field(8, b"\x10\x0d")
MANY = LARGEST // 4
BOMBS = {
    "properties": HEAD + field(14, b"") * MANY,
    "functions": HEAD + field(25, b"") * MANY,
    "nodes": HEAD + field(7, field(1, b"") * MANY),
    "initializers": HEAD + field(7, field(5, b"") * MANY),
    "dimensions": HEAD + field(7, field(5, field(1, bytes(MANY)))),
    "texts": HEAD + field(7, field(5, field(6, b"") * MANY)),
    "attributes": HEAD + field(7, field(1, field(5, field(9, b"") * MANY))),
    "empty weights": HEAD + field(7, field(5, field(9, b"") * MANY)),
    "graphs": HEAD + field(7, b"") * MANY,
}


@pytest.mark.parametrize("content", BOMBS.values(), ids=BOMBS)
def test_millions_of_short_messages_are_refused_before_protobuf_sees_them(content: bytes) -> None:
    with pytest.raises(PolicyError, match="256 kB of it are not raw weights"):
        parse(content)


def test_weights_do_not_count() -> None:
    size_check.check(HEAD + field(7, field(5, field(9, bytes(10 * 2**20)))))


def test_the_policy_that_comes_with_fishd_is_far_below_the_limit() -> None:
    content = library.find("default-fish").read_bytes()
    size_check.check(content + field(14, bytes(200 * 2**10)))


@given(st.binary(max_size=200))
def test_any_bytes_are_counted_or_refused(content: bytes) -> None:
    try:
        size_check.check(content)
    except PolicyError:
        return


@pytest.mark.parametrize("content", [b"\x0a", b"\x0a\x05abc", b"\x0b", b"\xff" * 11, b"\x09abc"])
def test_what_breaks_off_is_no_model(content: bytes) -> None:
    with pytest.raises(PolicyError, match="this is not an ONNX model"):
        parse(content)
