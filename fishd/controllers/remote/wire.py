"""Socket of the controller `remote` for its agent, which has a ROUTER or a DEALER socket."""

import re
import select
from collections.abc import Callable

import msgspec

from fishd.core.agent_messages import MAX_MESSAGE, VERSION, FromAgent, decode_from_agent
from fishd.core.decoding import decoder
from fishd.core.errors import ControllerFault, ParameterError
from fishd.core.zmtp import Dealer

_MAX_EXCERPT_BYTES = 200
"""Maximum length of an excerpt of an invalid message [bytes]."""


class _Versioned(msgspec.Struct):
    """The part of a message that all versions have."""

    v: int = VERSION


_decode_version: Callable[[bytes], _Versioned] = decoder(_Versioned)


class Wire(Dealer[FromAgent | ControllerFault]):
    """Connection to the agent."""

    def __init__(self, address: str) -> None:
        """Raises `ParameterError` if the address is invalid."""
        self._address = address
        try:
            super().__init__(address, MAX_MESSAGE)
        except ValueError as error:
            raise ParameterError(
                f"agent: cannot connect to '{address}': {error}", ("agent",)
            ) from None

    def receive(self) -> FromAgent:
        """Return a message; only if `state` reports one.

        Raise `ControllerFault` if it is not a valid message of an agent.
        """
        message = self._inbox.popleft()
        if isinstance(message, ControllerFault):
            raise message
        return message

    def wait(self, seconds: float) -> None:
        """Wait until `state` may have changed, at most for this time [s]."""
        # epoll counts whole milliseconds, which is too coarse for short ticks.
        select.select([self._poll], [], [], self._until_attempt(seconds))

    def _decode(self, payload: bytes) -> FromAgent | ControllerFault:
        try:
            message = decode_from_agent(payload)
        except msgspec.DecodeError as error:  # of the syntax or the content
            return self._bad(_describe_problem(payload, error))
        return message if message.v == VERSION else self._bad(_other_version(message.v))

    def _bad(self, what: str) -> ControllerFault:
        return ControllerFault("remote-error", f"the agent at {self._address} sent {what}")


def _describe_problem(payload: bytes, error: msgspec.DecodeError) -> str:
    try:
        version = _decode_version(payload).v
    except msgspec.DecodeError:
        version = VERSION
    if version != VERSION:
        return _other_version(version)
    return f"{_excerpt(payload, str(error))!r}, which is neither an action nor a pause: {error}"


def _excerpt(payload: bytes, error: str) -> str:
    """Return the invalid part of a message, around the byte that the decoder names."""
    match = re.search(r"\(byte (\d+)\)", error)
    begin = (
        max(0, int(match[1]) - _MAX_EXCERPT_BYTES // 2)
        if match and len(payload) > _MAX_EXCERPT_BYTES
        else 0
    )
    excerpt = payload[begin : begin + _MAX_EXCERPT_BYTES]
    before, after = "…" * (begin > 0), "…" * (begin + len(excerpt) < len(payload))
    return f"{before}{excerpt.decode(errors='replace')}{after}"


def _other_version(version: int) -> str:
    return f"a message of version {version}; this fishd needs version {VERSION}"
