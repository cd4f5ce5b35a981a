"""How much of a policy file is anything but the weights of its network, told without protobuf.

protobuf makes some ninety bytes of each message, however short, and lets nothing else run
meanwhile: a file of the permitted length could take gigabytes. Weights, as raw data, take what they
have.
"""

from collections.abc import Iterator

MOST = 256 * 2**10
"""Of all that is no weight: the card, the names, the layers [bytes]."""

_GRAPH, _INITIALIZER, _RAW_DATA = 7, 5, 9
"""Numbers of the fields that lead to the weights: of a model, of a graph, of a tensor."""
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_FIXED = {_FIXED64: 8, _FIXED32: 4}


class TooMuch(Exception):
    """More than MOST is no weight."""


class Broken(Exception):
    """This is not how protobuf writes."""


def check(content: bytes) -> None:
    """Raises `TooMuch` or `Broken`."""
    left = MOST
    for number, begin, end, size in _fields(content, 0, len(content)):
        left -= size - (end - begin) * (number == _GRAPH)
        for inner, first, last, inner_size in _inside(number == _GRAPH, content, begin, end):
            left -= inner_size - (last - first) * (inner == _INITIALIZER)
            for part, start, stop, part_size in _inside(
                inner == _INITIALIZER, content, first, last
            ):
                left -= part_size - (stop - start) * (part == _RAW_DATA)
                _enough(left)
            _enough(left)
        _enough(left)


def _enough(left: int) -> None:
    if left < 0:
        raise TooMuch


def _inside(
    wanted: bool, content: bytes, begin: int, end: int
) -> Iterator[tuple[int, int, int, int]]:
    return _fields(content, begin, end) if wanted else iter(())


def _fields(content: bytes, begin: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """Number, begin and end of the value, and whole size of each field of a message."""
    at = begin
    while at < end:
        key, value = _varint(content, at, end)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            _, stop = _varint(content, value, end)
        elif kind == _BYTES:
            length, value = _varint(content, value, end)
            stop = value + length
        elif kind in _FIXED:
            stop = value + _FIXED[kind]
        else:
            raise Broken
        if stop > end:
            raise Broken
        yield number, value, stop, stop - at
        at = stop


def _varint(content: bytes, at: int, end: int) -> tuple[int, int]:
    """A number, and where it ends."""
    number = 0
    for shift in range(0, 70, 7):
        if at >= end:
            raise Broken
        byte = content[at]
        at += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, at
    raise Broken
