"""The socket between the controller `remote` and its agent, which has a ROUTER or a DEALER."""

import re
import select
from collections.abc import Callable

import msgspec

from fishd.core.agent_messages import MAX_MESSAGE, VERSION, FromAgent, decode_from_agent
from fishd.core.decoding import decoder
from fishd.core.errors import ControllerFault, ParameterError
from fishd.core.zmtp import Dealer

_SHOWN = 200
"""How much of a bad message is shown [bytes]."""


class _Versioned(msgspec.Struct):
    """Any message, as far as every version will have it."""

    v: int = VERSION


_decode_version: Callable[[bytes], _Versioned] = decoder(_Versioned)


class Wire(Dealer[FromAgent | ControllerFault]):
    """A connection to the agent."""

    def __init__(self, address: str) -> None:
        """Raises `ParameterError` where the address is none."""
        self._address = address
        try:
            super().__init__(address, MAX_MESSAGE)
        except ValueError as error:
            raise ParameterError(
                f"agent: cannot connect to '{address}': {error}", ("agent",)
            ) from None

    def receive(self) -> FromAgent:
        """Return a message, where `state` says that there is one.

        Raises `ControllerFault` when it is not a message that an agent may send.
        """
        message = self._inbox.popleft()
        if isinstance(message, ControllerFault):
            raise message
        return message

    def wait(self, seconds: float) -> None:
        """Return when `state` may have changed, or after a while."""
        # epoll counts whole milliseconds, too coarse for a tick of a few.
        select.select([self._poll], [], [], self._until_attempt(seconds))

    def _decode(self, payload: bytes) -> FromAgent | ControllerFault:
        try:
            message = decode_from_agent(payload)
        except msgspec.DecodeError as error:  # of the syntax, or of what is in it
            return self._bad(_why(payload, error))
        return message if message.v == VERSION else self._bad(_other_version(message.v))

    def _bad(self, what: str) -> ControllerFault:
        return ControllerFault("remote-error", f"the agent at {self._address} sent {what}")


def _why(payload: bytes, error: msgspec.DecodeError) -> str:
    try:
        version = _decode_version(payload).v
    except msgspec.DecodeError:
        version = VERSION
    if version != VERSION:
        return _other_version(version)
    return f"{_excerpt(payload, str(error))!r}, which is neither an action nor a pause: {error}"


def _excerpt(payload: bytes, error: str) -> str:
    """Return the part of a message that is wrong: around the byte that the decoder names."""
    match = re.search(r"\(byte (\d+)\)", error)
    begin = max(0, int(match[1]) - _SHOWN // 2) if match and len(payload) > _SHOWN else 0
    shown = payload[begin : begin + _SHOWN]
    before, after = "…" * (begin > 0), "…" * (begin + len(shown) < len(payload))
    return f"{before}{shown.decode(errors='replace')}{after}"


def _other_version(version: int) -> str:
    return f"a message of version {version}; this fishd needs version {VERSION}"
