"""Decodes JSON that comes from elsewhere, whatever it is."""

from collections.abc import Callable
from typing import Any

import msgspec


def decoder(kind: Any) -> Callable[[bytes], Any]:
    """What makes a message of this kind of bytes; raises `msgspec.DecodeError`, and nothing else.

    By itself msgspec raises other errors for text that is no UTF-8, and for what is nested deeply.
    """
    decode = msgspec.json.Decoder(kind).decode

    def decoded(payload: bytes) -> Any:
        try:
            return decode(payload)
        except (UnicodeDecodeError, RecursionError) as error:
            raise msgspec.DecodeError(str(error)) from None

    return decoded
