"""Requests to a running `fishd-camera`, and how its addresses are reached."""

import itertools
import os
from contextlib import suppress
from typing import TypeVar, cast

import msgspec
import zmq

from fishd.camera.messages import STATE, CameraState
from fishd.camera.settings import CameraSettings, PublishSettings
from fishd.client.connection import deadlines
from fishd.client.zmq_sockets import milliseconds_until
from fishd.core import addresses, protocol, text
from fishd.core.decoding import decoder
from fishd.core.errors import FishError, Refused

ENDPOINT_VARIABLE = "FISHD_CAMERA"
LONGEST = 16 * 2**20
"""Of a message that is received [bytes]."""
_SECOND_LOOK = 300
"""How long it takes at most to find out that a silent address is that of frames [ms]."""

T = TypeVar("T")


class CameraLost(FishError, ConnectionError):
    """No camera answers, or it has no frames; the message says which, and what to do."""


def find_camera() -> str:
    """Where a camera takes requests: $FISHD_CAMERA, else that of this machine."""
    return os.environ.get(ENDPOINT_VARIABLE) or PublishSettings().requests


class CameraRequests:
    """Asks a camera; for one thread. Raises `CameraLost` when nobody answers in time."""

    def __init__(
        self, endpoint: str, context: "zmq.Context[zmq.Socket[bytes]]", timeout: float
    ) -> None:
        """timeout: how long to wait for an answer [s]"""
        self.endpoint = endpoint
        self.timeout = timeout
        self._context = context
        self._ids = itertools.count(1)
        self._socket = context.socket(zmq.DEALER)
        self._socket.set(zmq.LINGER, 0)
        self._socket.set(zmq.IMMEDIATE, 1)
        self._socket.set(zmq.MAXMSGSIZE, LONGEST)
        connect(self._socket, endpoint)

    def status(self, timeout: float | None = None) -> CameraState:
        """What the camera says of itself; timeout: how long to wait [s], None: as for others."""
        return self._call(CameraState, "status", timeout)

    def settings(self) -> CameraSettings:
        """The settings that it was started with, but for a password."""
        return self._call(CameraSettings, "config")

    def _call(self, kind: type[T], op: str, timeout: float | None = None) -> T:
        """Ask; raises `CameraLost` and `Refused`."""
        identity = next(self._ids)
        request = protocol.Request(v=protocol.VERSION, id=identity, op=op)
        patience = self.timeout if timeout is None else timeout
        wanted = zmq.POLLOUT
        hurry = timeout is not None  # within a tick there is no time for more
        for deadline in deadlines(patience, again=not hurry):
            while self._socket.poll(milliseconds_until(deadline), wanted):
                if wanted == zmq.POLLOUT:
                    self._socket.send(protocol.encode(request))
                    wanted = zmq.POLLIN
                    continue
                with suppress(msgspec.DecodeError):
                    reply = protocol.decode_reply(self._socket.recv_multipart()[-1])
                    if reply.id != identity:
                        continue
                    if reply.error:
                        raise Refused(text.quoted(reply.error.code), text.line(reply.error.message))
                    if reply.result:
                        return cast(T, decoder(kind)(reply.result))
        if not hurry and self._publishes():
            raise CameraLost(
                f"at {self.endpoint} a camera publishes its frames; requests go to another address "
                f"of it: its publish.requests, {PublishSettings().requests} by default"
            )
        raise CameraLost(
            f"no camera at {self.endpoint}: no answer within {patience:g} s; start one with "
            f"'fishd-camera', or name another with --camera or ${ENDPOINT_VARIABLE}"
        )

    def _publishes(self) -> bool:
        """Do frames go out there? Each subscriber to the state of a camera gets it at once."""
        with self._context.socket(zmq.SUB) as socket:
            socket.set(zmq.LINGER, 0)
            socket.set(zmq.MAXMSGSIZE, LONGEST)
            socket.subscribe(STATE)
            connect(socket, self.endpoint)
            return bool(socket.poll(_SECOND_LOOK)) and socket.recv_multipart()[0] == STATE


def reachable(frames: str, endpoint: str) -> str:
    """Where the camera that takes requests at `endpoint` publishes, as seen from here."""
    ours, theirs = addresses.parse(endpoint), addresses.parse(frames)
    if isinstance(ours, addresses.Ipc) or isinstance(theirs, addresses.Ipc):
        return frames
    if theirs.host not in ("0.0.0.0", "::"):
        return frames
    host = f"[{ours.host}]" if ":" in ours.host else ours.host
    return f"tcp://{host}:{theirs.port}"  # of all its addresses, the one that answers


def connect(socket: "zmq.Socket[bytes]", address: str) -> None:
    """Raises `CameraLost` when the address is none."""
    if address.endswith((".yaml", ".yml")) and "://" not in address:
        raise CameraLost(
            f"'{text.quoted(address)}' is a file, for 'fishd-camera --config' and for simulated "
            "fish; here the address at which a running fishd-camera takes requests is needed, such "
            f"as {PublishSettings().requests}"
        )
    if complaint := addresses.why_not_connected(address):
        raise CameraLost(f"'{address}' is no address of a camera: {complaint}")
    try:
        socket.set(zmq.IPV6, addresses.is_ipv6(address))
        socket.connect(address)
    except zmq.ZMQError as error:
        raise CameraLost(
            f"'{address}' is no address of a camera: {zmq.strerror(error.errno or 0)}"
        ) from None
