"""Both gateways of a fishd: what is sent to them, and what is told of them."""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Protocol

from fishd import addresses
from fishd.gateway import link
from fishd.gateway.process import Gateway
from fishd.reporting import Reporter


class Server(Protocol):
    """What answers requests."""

    send: Callable[[bytes], bool]
    """Takes a message for the gateway, without waiting; False where there is no room for it."""
    read: Callable[[bool], object]
    """Says whether the gateway is to hand over more requests."""

    def take(self, message: bytes) -> None:
        """Begin to answer a request."""


class Gateways:
    """Listens at both addresses from now on, until `stack` is closed."""

    def __init__(self, control: str, telemetry: str, stack: ExitStack) -> None:
        """Must be made inside a running asyncio loop.

        control, telemetry: addresses, which must be `claimed`
        Raises `StartupError`.
        """
        self.control = _open(link.CONTROL, control, stack)
        self.telemetry = _open(link.TELEMETRY, telemetry, stack)
        stack.callback(self.control.end)  # so that both end at the same time

    def serve(self, server: Server, reporter: Reporter) -> None:
        """Let requests come in and replies go out, and tell when a gateway was started again."""
        server.send, server.read = self.control.send, self.control.read
        self.control.take = server.take
        self.control.read(True)
        for gateway in (self.control, self.telemetry):
            gateway.on_restart = partial(_tell_restart, reporter, gateway.kind)

    def counters(self) -> dict[str, int]:
        """What was survived, since start."""
        return {
            "telemetry_lost": self.telemetry.lost,
            "telemetry_restarts": self.telemetry.restarts,
            "control_restarts": self.control.restarts,
        }


def _open(kind: str, address: str, stack: ExitStack) -> Gateway:
    listener = addresses.listen(address, f"{kind}.address", group=kind == link.CONTROL)
    stack.callback(listener.close)
    gateway = Gateway(kind, listener, addresses.served(address, listener))
    stack.callback(gateway.close)
    return gateway


def _tell_restart(reporter: Reporter, kind: str, why: str) -> None:
    message = f"the gateway of {kind} was started again: {why}"
    reporter.event("gateway", message, "warning", gateway=kind)
