"""The control protocol: JSON requests and replies, shared by server and client.

docs/reference/protocol.md is its reference for clients in other languages; its tables are
written from what is declared here (`make docs`).
"""

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import msgspec
from msgspec import UNSET, Meta, Struct, UnsetType

from fishd.core import text
from fishd.core.calibration import ForceCalibration, ServoCalibration
from fishd.core.decoding import decoder
from fishd.core.errors import Refused
from fishd.core.schema import PRINTABLE, note, unit
from fishd.core.signals import MODES, LeaseHolder, Reason

VERSION = 1
MAX_MESSAGE = 16384
"""Longer messages are not even received [bytes]."""

LEASE = 2.0
"""Time for which a lease of the fish lasts without being renewed, by default [s]."""
SHORTEST_LEASE = 0.5
"""[s]"""
LONGEST_LEASE = 60.0
"""[s]"""
FRESH = 10.0
"""How long after it was taken a force sample is good for a tare [s]."""

LOADING = 10.0
"""How long a controller may take to load, and files to be read or written [s]."""

BEGINNINGS = {"set-controller", "clear-fault", "calibrate-servo"}
"""Operations after which a fish at rest moves, or its servo gets pulses."""
WAITED = 5.0
"""One of these that waited longer is refused: whoever asked may have given up [s]."""

RequestId = int | Annotated[str, Meta(max_length=256)] | None

Line = Annotated[str, Meta(max_length=1000, pattern=PRINTABLE)]
"""Text that goes into logs and terminals: one line without control characters."""


class Request(Struct, forbid_unknown_fields=True):
    """What a client asks for."""

    v: Annotated[int, note("Version of this protocol: 1.")]
    op: Annotated[str, note("What to do.", max_length=64)]
    id: Annotated[RequestId, note("Comes back in the reply; optional.")] = None
    args: Annotated[
        dict[str, Any], note("Arguments of the operation; optional where it needs none.")
    ] = {}


class OnlyId(Struct):
    """A request of which nothing but its id matters."""

    id: RequestId = None


class Failure(Struct, frozen=True):
    """Why a request was refused."""

    code: Annotated[str, note("One of the codes below.")]
    message: Annotated[str, note("One line that says what would be right.")]


class Reply(Struct, frozen=True):
    """The answer: `result` where `ok`, else `error`."""

    v: Annotated[int, note("Version of this protocol: 1.")]
    id: Annotated[RequestId, note("That of the request; null where it cannot be read.")]
    ok: Annotated[bool, note("Was the request carried out?")]
    result: Annotated[msgspec.Raw | UnsetType, note("What the operation gives.")] = UNSET
    error: Annotated[Failure | UnsetType, note("Why it was refused.")] = UNSET


class State(Struct, frozen=True):
    """The answer to every request that changes something."""

    seq: Annotated[int, note("Number of the first tick that is affected.")]
    mode: Annotated[str, note(MODES)]
    reason: Annotated[Reason | None, note("Why, in mode fault and estop.")]
    controller: Annotated[str, note("The active controller.")]
    parameters: Annotated[dict[str, Any], note("All its parameters.")]
    took_from: Annotated[
        LeaseHolder | None,
        note("The experiment whose [lease](#leases) this request has ended; null where none did."),
    ] = None


class Grant(Struct, frozen=True):
    """The answer to take-lease."""

    lease: Annotated[str, note("Names the lease in the requests of its holder.")]
    seconds: Annotated[float, unit("s", "Time that it lasts from each renewal on.")]
    took_from: Annotated[
        LeaseHolder | None, note("The holder before, from whom the fish was taken; else null.")
    ] = None


class PolicyInfo(Struct, frozen=True, kw_only=True):
    """A policy, named or by its path."""

    name: str
    file: str
    """Its path."""
    problem: str
    """Why it cannot be used, in one line; empty where it can."""
    card: dict[str, Any] | None
    """What the file says about itself, as JSON; None where it is not a policy file."""
    sees: str = ""
    """What it is shown of the fish: `forces`, `pictures` or `forces, pictures`."""


class NoArguments(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of an operation that takes none."""


class SetController(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of set-controller."""

    name: str
    parameters: dict[str, Any] = {}
    lease: str | None = None


class SetParameter(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of set-parameter."""

    parameters: dict[str, Any]
    lease: str | None = None


class Stop(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of stop."""

    lease: str | None = None


class Estop(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of estop."""

    message: Line = "requested by a client"


class SampleForce(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of sample-force."""

    seconds: Annotated[float, Meta(ge=0.1, le=60)] = 2.0


class Tare(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of tare: the `number` of a sample that is at most `FRESH` seconds old."""

    sample: int
    lease: str | None = None


class CalibrateForce(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of calibrate-force."""

    calibration: ForceCalibration
    lease: str | None = None


class CalibrateServo(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of calibrate-servo; without `save`, the calibration ends with the lease."""

    calibration: ServoCalibration
    save: bool = False
    lease: str | None = None


class CalibrateThrust(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of calibrate-thrust: thrust [N] over the mean square of `fin_velocity`."""

    factor: Annotated[float, Meta(ge=1e-9, le=1e9)]
    error: Annotated[float, Meta(ge=1e-12, le=1e9)]
    """Half of its 95 % interval."""


class TakeLease(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of take-lease."""

    name: Annotated[str, Meta(min_length=1, max_length=60, pattern=PRINTABLE)]
    """What the experiment is called in messages, such as `measure`."""
    host: Annotated[str, Meta(max_length=64, pattern=PRINTABLE)] = ""
    """The machine on which it runs."""
    pid: int = 0
    """Its process."""
    seconds: Annotated[float, Meta(ge=SHORTEST_LEASE, le=LONGEST_LEASE)] | None = None
    """Time that the lease lasts without a renewal [s]; None: as configured."""
    take: bool = False
    """Whether to take the fish from another holder."""


class HeldLease(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of renew-lease and end-lease."""

    lease: str


class Calibrations(Struct, frozen=True):
    """The calibrations that are used now, and their files."""

    force: Annotated[ForceCalibration, note("That of the force sensor, see below.")]
    force_file: Annotated[str | None, note("Its file; null where it comes from the configuration.")]
    servo: Annotated[
        ServoCalibration,
        note("`trim` [µs], `direction`, `scale` [µs/rad], `lowest`, `highest` [rad], `date`."),
    ]
    servo_file: Annotated[str | None, note("Its file, likewise.")]
    force_limit: Annotated[
        float, unit("N", "A force beyond ± this is not believed: `force_sensor.force_limit`.")
    ]
    on_trial: Annotated[
        bool, note("True while that of the servo is only tried, under a [lease](#leases).")
    ] = False


class Mark(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of mark."""

    text: Line


class Operation(NamedTuple):
    """What can be asked for."""

    arguments: type[Struct]
    result: str
    """What it gives, in the words of docs/reference/protocol.md."""
    does: str
    """What it does, likewise."""


_STATE = "[state](#state)"
_CALIBRATIONS = "[calibrations](#calibrations)"
_CONFIG = "the [configuration](configuration.md) that `fishd` was started with, an object a section"
OPERATIONS = {
    "status": Operation(NoArguments, "[status](#status)", "nothing"),
    "controllers": Operation(NoArguments, "list of [controllers](#controllers)", "nothing"),
    "policies": Operation(NoArguments, "list of [policies](#policies)", "nothing"),
    "config": Operation(NoArguments, _CONFIG, "nothing"),
    "set-controller": Operation(
        SetController,
        _STATE,
        "makes a new controller the active one; parameters left out take their defaults",
    ),
    "set-parameter": Operation(
        SetParameter, _STATE, "changes these parameters of the active controller, all or none"
    ),
    "stop": Operation(Stop, _STATE, "fades to neutral; mode idle. In fault and estop: nothing"),
    "estop": Operation(Estop, _STATE, "stops the pulses at once; mode estop"),
    "clear-fault": Operation(
        NoArguments, _STATE, "leaves mode fault or estop for idle. Otherwise: nothing"
    ),
    "take-lease": Operation(
        TakeLease,
        "[lease](#leases)",
        "gives the client the fish for as long as it renews the lease; moves nothing",
    ),
    "renew-lease": Operation(HeldLease, _STATE, "lets the lease last again for its full time"),
    "end-lease": Operation(
        HeldLease, _STATE, "ends the lease, and fades to neutral what was set under it"
    ),
    "mark": Operation(Mark, _STATE, "publishes an event `mark`"),
    "calibrations": Operation(NoArguments, _CALIBRATIONS, "nothing"),
    "sample-force": Operation(
        SampleForce, "[force sample](#calibrations)", "measures for this time"
    ),
    "tare": Operation(
        Tare,
        _CALIBRATIONS,
        f"calls the force sample of that `number`, one of the last {FRESH:g} s, zero force; saved",
    ),
    "calibrate-force": Operation(
        CalibrateForce,
        _CALIBRATIONS,
        "saves it and uses it from the next tick on; what is left out takes its default",
    ),
    "calibrate-servo": Operation(
        CalibrateServo,
        _CALIBRATIONS,
        "uses it from the next tick on: saved, or else until the [lease](#leases) ends",
    ),
    "calibrate-thrust": Operation(
        CalibrateThrust,
        _STATE,
        "takes the factor from a measurement, and shows the thrust by it until fishd ends",
    ),
}
"""All operations, by name."""

encode = msgspec.json.Encoder().encode
decode_reply: Callable[[bytes], Reply] = decoder(Reply)
_decode_request: Callable[[bytes], Request] = decoder(Request)
_decode_id: Callable[[bytes], OnlyId] = decoder(OnlyId)


def decode_request(payload: bytes) -> Request:
    """The request in `payload`; raises `Refused` with code `bad-request` or `version`."""
    try:
        request = _decode_request(payload)
    except msgspec.DecodeError as error:
        raise Refused("bad-request", f"not a request: {error}") from None
    if request.v != VERSION:
        raise Refused(
            "version", f"protocol version {request.v} is not spoken here; this is {VERSION}"
        )
    return request


def request_id(payload: bytes) -> RequestId:
    """The id of a request that may be broken otherwise; None where it cannot be told."""
    try:
        return _decode_id(payload).id
    except msgspec.DecodeError:
        return None


def success(identity: RequestId, result: Any) -> bytes:
    """A reply with a result."""
    return encode(Reply(v=VERSION, id=identity, ok=True, result=msgspec.Raw(encode(result))))


def failure(identity: RequestId, error: Refused) -> bytes:
    """A reply with an error."""
    why = Failure(text.quoted(error.code), text.said(error))
    return encode(Reply(VERSION, identity, ok=False, error=why))
