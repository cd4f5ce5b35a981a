"""The control protocol: JSON requests and replies, shared by server and client.

docs/protocol.md is its reference for clients in other languages.
"""

from typing import Annotated, Any

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from fishd import text
from fishd.errors import Refused
from fishd.hardware.calibration import ForceCalibration, ServoCalibration
from fishd.signals import Reason

VERSION = 1
MAX_MESSAGE = 16384
"""Longer messages are not even received [bytes]."""

LOAN = 5.0
"""How long a servo calibration that is not saved stays in force without being renewed [s]."""
FRESH = 10.0
"""How long after it was taken a force sample is good for a tare [s]."""

LOADING = 10.0
"""How long a controller may take to load, and a file to be written [s]."""

RequestId = int | Annotated[str, Meta(max_length=256)] | None

Line = Annotated[str, Meta(max_length=1000, pattern="^[^\x00-\x1f\x7f-\x9f]*$")]
"""Text that goes into logs and terminals: one line without control characters."""


class Request(Struct, forbid_unknown_fields=True):
    """What a client asks for."""

    v: int
    op: Annotated[str, Meta(max_length=64)]
    id: RequestId = None
    args: dict[str, Any] = {}


class OnlyId(Struct):
    """A request of which nothing but its id matters."""

    id: RequestId = None


class Failure(Struct, frozen=True):
    """Why a request was refused."""

    code: str
    message: str


class Reply(Struct, frozen=True):
    """The answer: `result` where `ok`, else `error`."""

    v: int
    id: RequestId
    ok: bool
    result: msgspec.Raw | UnsetType = UNSET
    error: Failure | UnsetType = UNSET


class State(Struct, frozen=True):
    """The answer to every request that changes something: what is in force from now on."""

    seq: int
    """The first tick that is affected."""
    mode: str
    reason: Reason | None
    controller: str
    parameters: dict[str, Any]


class NoArguments(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of status, controllers, policies, config, stop and clear-fault."""


class SetController(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of set-controller."""

    name: str
    parameters: dict[str, Any] = {}


class SetParameter(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of set-parameter."""

    parameters: dict[str, Any]


class Estop(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of estop."""

    message: Line = "requested by a client"


class SampleForce(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of sample-force."""

    seconds: Annotated[float, Meta(ge=0.1, le=60)] = 2.0


class Tare(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of tare: the `number` of a sample that is at most `FRESH` seconds old."""

    sample: int


class CalibrateForce(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of calibrate-force: it is saved, and in force from the next tick on."""

    calibration: ForceCalibration


class CalibrateServo(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of calibrate-servo: in force from the next tick on, saved or for a loan only.

    A loan ends unless it is renewed; whoever has it names it in each change, and to save.
    """

    calibration: ServoCalibration
    save: bool = False
    loan: str | None = None


class ServoLoan(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of renew-loan and end-loan."""

    loan: str


class Calibrations(Struct, frozen=True):
    """The calibrations in force, and their files; null where they come from the configuration.

    `loan` is null unless that of the servo is in force for a loan only. A force beyond
    ±`force_limit` [N] is not believed.
    """

    force: ForceCalibration
    force_file: str | None
    servo: ServoCalibration
    servo_file: str | None
    force_limit: float
    loan: str | None = None


class Mark(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of mark."""

    text: Line


_request_decoder = msgspec.json.Decoder(Request)
_id_decoder = msgspec.json.Decoder(OnlyId)
_reply_decoder = msgspec.json.Decoder(Reply)
_encoder = msgspec.json.Encoder()


def encode(message: Any) -> bytes:
    """A message as JSON."""
    return _encoder.encode(message)


def decode_request(payload: bytes) -> Request:
    """The request in `payload`; raises `Refused` with code `bad-request` or `version`."""
    try:
        request = _request_decoder.decode(payload)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise Refused("bad-request", f"not a request: {error}") from None
    if request.v != VERSION:
        raise Refused(
            "version", f"protocol version {request.v} is not spoken here; this is {VERSION}"
        )
    return request


def request_id(payload: bytes) -> RequestId:
    """The id of a request that may be broken otherwise; None where it cannot be told."""
    try:
        return _id_decoder.decode(payload).id
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None


def decode_reply(payload: bytes) -> Reply:
    """The reply in `payload`; raises msgspec.DecodeError."""
    return _reply_decoder.decode(payload)


def success(identity: RequestId, result: Any) -> bytes:
    """A reply with a result."""
    return encode(Reply(v=VERSION, id=identity, ok=True, result=msgspec.Raw(encode(result))))


def failure(identity: RequestId, error: Refused) -> bytes:
    """A reply with an error."""
    why = Failure(text.quoted(error.code), text.said(error))
    return encode(Reply(VERSION, identity, ok=False, error=why))
