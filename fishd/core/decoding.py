"""Decoding of JSON from untrusted sources."""

from collections.abc import Callable
from typing import Any

import msgspec


def decoder(kind: Any) -> Callable[[bytes], Any]:
    """Return a function that decodes bytes into this type; it raises only `msgspec.DecodeError`.

    msgspec alone raises other errors for text that is not UTF-8 and for deep nesting.
    """
    decode = msgspec.json.Decoder(kind).decode

    def decoded(payload: bytes) -> Any:
        try:
            return decode(payload)
        except (UnicodeDecodeError, RecursionError) as error:
            raise msgspec.DecodeError(str(error)) from None

    return decoded
