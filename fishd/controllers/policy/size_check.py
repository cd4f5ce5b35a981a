"""Size of the parts of a policy file other than weights, measured without protobuf.

protobuf allocates about ninety bytes for each message, however short, and blocks all other threads
while it parses: a file of the permitted size could take gigabytes. Weights, as raw data, take only
their size.
"""

from collections.abc import Iterator

from fishd.core.errors import PolicyError

EXPORT_REMEDY = "export it with 'fishctl learn export'"
NOT_ONNX = f"this is not an ONNX model; {EXPORT_REMEDY}"
MAX_OVERHEAD_BYTES = 256 * 2**10
"""Maximum size of everything except weights: the card, the names, the layers [bytes]."""

_GRAPH, _INITIALIZER, _RAW_DATA = 7, 5, 9
"""Field numbers of the path to the weights: in a model, in a graph, in a tensor."""
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_FIXED = {_FIXED64: 8, _FIXED32: 4}


def check(content: bytes) -> None:
    """Raise `PolicyError` for more than `MAX_OVERHEAD_BYTES`, or for invalid protobuf."""
    remaining = MAX_OVERHEAD_BYTES
    for size in _overheads(content, 0, len(content), (_GRAPH, _INITIALIZER, _RAW_DATA)):
        remaining -= size
        if remaining < 0:
            raise PolicyError(
                f"more than {MAX_OVERHEAD_BYTES // 2**10} kB of it are not raw weights, far more "
                "than a policy "
                "needs; save weights as raw data"
            )


def _overheads(content: bytes, begin: int, end: int, path: tuple[int, ...]) -> Iterator[int]:
    """Yield the size of each field of a message, without the fields at `path` [bytes]."""
    for number, first, last, size in _fields(content, begin, end):
        if number != path[0]:
            yield size
            continue
        yield size - (last - first)
        if path[1:]:
            yield from _overheads(content, first, last, path[1:])


def _fields(content: bytes, begin: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """Yield number, begin and end of the value, and total size of each field of a message."""
    position = begin
    while position < end:
        key, value = _varint(content, position, end)
        number, kind = key >> 3, key & 7
        if kind == _VARINT:
            _, stop = _varint(content, value, end)
        elif kind == _BYTES:
            length, value = _varint(content, value, end)
            stop = value + length
        elif kind in _FIXED:
            stop = value + _FIXED[kind]
        else:
            raise PolicyError(NOT_ONNX)
        if stop > end:
            raise PolicyError(NOT_ONNX)
        yield number, value, stop, stop - position
        position = stop


def _varint(content: bytes, position: int, end: int) -> tuple[int, int]:
    """Return a number, and the position after it."""
    number = 0
    for shift in range(0, 70, 7):
        if position >= end:
            raise PolicyError(NOT_ONNX)
        byte = content[position]
        position += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, position
    raise PolicyError(NOT_ONNX)
