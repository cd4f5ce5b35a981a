"""Requests to a running `fishd-camera`, and connections to its addresses."""

import itertools
import os
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Self, TypeVar, cast

import msgspec
import zmq

from fishd.camera.messages import STATE, CameraState
from fishd.camera.settings import CameraSettings, PublishSettings
from fishd.client.connection import answer_deadlines
from fishd.client.request_socket import Requester, RequestSocket
from fishd.core import addresses, protocol, text
from fishd.core.decoding import decoder
from fishd.core.errors import FishError, Refused
from fishd.core.names import find_name_problem

if TYPE_CHECKING:
    from fishd.camera.tail.lens import Lens

ENDPOINT_VARIABLE = "FISHD_CAMERA"
MAX_MESSAGE_BYTES = 16 * 2**20
"""Largest size of a received message [bytes]."""
_PUBLISHER_CHECK_MS = 300
"""Longest check whether an address without answers is that of frames [ms]."""

T = TypeVar("T")


class CameraLost(FishError, ConnectionError):
    """No camera answers, or it has no frames; the message says which, and what to do."""


def find_camera() -> str:
    """Return the address of a camera's requests: $FISHD_CAMERA, else that of this machine."""
    return os.environ.get(ENDPOINT_VARIABLE) or PublishSettings().requests


class CameraRequests:
    """Requests to a camera, for one thread; they raise `CameraLost` without a timely answer."""

    def __init__(self, endpoint: str, timeout: float) -> None:
        """timeout: longest wait for an answer [s]; raises `CameraLost` for an invalid address."""
        check_address(endpoint)
        self.endpoint = endpoint
        self.timeout = timeout
        self._ids = itertools.count(1)
        open_socket = partial(RequestSocket, endpoint, program="fishd-camera")
        self._requester = Requester(open_socket, forgettable=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Disconnect; may be called twice."""
        self._requester.disconnect()

    def status(self, timeout: float | None = None) -> CameraState:
        """Return the camera's state; timeout: longest wait [s], None: that of the object."""
        return self._call(CameraState, "status", timeout)

    def settings(self) -> CameraSettings:
        """Return the camera's settings, without a password."""
        return self._call(CameraSettings, "config")

    def learn_tail(self) -> CameraState:
        """Let the camera collect pictures of the fish from now on, to learn its tail."""
        return self._call(CameraState, "learn_tail")

    def finish_tail(self) -> CameraState:
        """Let the camera learn from these pictures; its state says when it has done so."""
        return self._call(CameraState, "finish_tail")

    def cancel_tail(self) -> CameraState:
        """Let the camera forget these pictures, and measure on as before."""
        return self._call(CameraState, "cancel_tail")

    def lens(self) -> "Lens":
        """Return the calibration of the camera's lens; raises `Refused` without one."""
        from fishd.camera.tail.lens import Lens  # with OpenCV

        return self._call(Lens, "lens")

    def set_lens(self, lens: "Lens") -> CameraState:
        """Let the camera store a calibration of its lens; then the tail has to be learned again."""
        return self._call(CameraState, "set_lens", args=msgspec.to_builtins(lens))

    def _call(self, kind: type[T], op: str, timeout: float | None = None, **fields: Any) -> T:
        """Send a request and return its result; raises `CameraLost` and `Refused`."""
        identity = next(self._ids)
        request = protocol.encode(
            protocol.Request(v=protocol.VERSION, id=identity, op=op, **fields)
        )

        def read(payload: bytes) -> T | None:
            with suppress(msgspec.DecodeError):
                reply = protocol.decode_reply(payload)
                if reply.id == identity and reply.error:
                    raise Refused(text.quoted(reply.error.code), text.line(reply.error.message))
                if reply.id == identity and reply.result:
                    return cast(T, decoder(kind)(reply.result))
            return None

        timeout_s = self.timeout if timeout is None else timeout
        single_attempt = timeout is not None  # a call within a tick has no time for retries
        deadlines = answer_deadlines(timeout_s, again=not single_attempt)
        result = self._requester.exchange(request, read, deadlines)
        if result is not None:
            return result
        if not single_attempt and (problem := find_name_problem(self.endpoint)):
            raise CameraLost(f"no camera at {self.endpoint}: {problem}")
        if not single_attempt and self._publishes():
            raise CameraLost(
                f"{self.endpoint} is the address of a camera's frames; use the address of its "
                f"requests, publish.requests, {PublishSettings().requests} by default"
            )
        raise CameraLost(
            f"no camera at {self.endpoint}: no answer within {timeout_s:g} s; start one with "
            f"'fishd-camera', or name another with --camera or ${ENDPOINT_VARIABLE}, for the page "
            "with 'cameras' in its settings"
        )

    def _publishes(self) -> bool:
        """Return whether the address sends its state to a new subscriber, as one of frames does."""
        with zmq.Context() as context, context.socket(zmq.SUB) as socket:
            socket.set(zmq.LINGER, 0)
            socket.set(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
            socket.subscribe(STATE)
            connect(socket, self.endpoint)
            return bool(socket.poll(_PUBLISHER_CHECK_MS)) and socket.recv_multipart()[0] == STATE


def resolve_frames_address(frames: str, endpoint: str) -> str:
    """Return the address of a camera's frames for a connection from this machine.

    frames: address that the camera states; endpoint: address of its requests
    """
    request_address, frames_address = addresses.parse(endpoint), addresses.parse(frames)
    if isinstance(request_address, addresses.Ipc) or isinstance(frames_address, addresses.Ipc):
        return frames
    if frames_address.host not in ("0.0.0.0", "::"):
        return frames
    # The camera listens on all its addresses; use the one that answers.
    host = f"[{request_address.host}]" if ":" in request_address.host else request_address.host
    return f"tcp://{host}:{frames_address.port}"


def check_address(address: str) -> None:
    """Raise `CameraLost` when an address is not valid."""
    if address.endswith((".yaml", ".yml")) and "://" not in address:
        raise CameraLost(
            f"'{text.quoted(address)}' is a file, for 'fishd-camera --config' and for simulated "
            "fish; give the address at which a running fishd-camera takes requests, such as "
            f"{PublishSettings().requests}"
        )
    if complaint := addresses.find_connect_problem(address):
        raise CameraLost(f"'{address}' is not an address of a camera: {complaint}")


def connect(socket: "zmq.Socket[bytes]", address: str) -> None:
    """Connect a socket to an address; raises `CameraLost` when the address is not valid."""
    check_address(address)
    try:
        socket.set(zmq.IPV6, addresses.is_ipv6(address))
        socket.connect(address)
    except zmq.ZMQError as error:
        raise CameraLost(
            f"'{address}' is not an address of a camera: {zmq.strerror(error.errno or 0)}"
        ) from None
