"""The control protocol: JSON requests and replies, shared by server and client.

docs/reference/protocol.md is its reference for clients in other languages; its tables are
generated from the declarations here (`make docs`).
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

VERSION = 2
MAX_MESSAGE = 16384
"""Maximum size of a message; longer ones are not received [bytes]."""

DEFAULT_LEASE_S = 2.0
"""Default duration of a lease without a renewal [s]."""
MIN_LEASE_S = 0.5
MAX_LEASE_S = 60.0
MAX_SAMPLE_AGE_S = 10.0
"""Maximum age of a force sample that a tare may use [s]."""

LOADING_TIMEOUT_S = 10.0
"""Maximum time to load a controller, and to read or write files [s]."""

READ_OPERATIONS = {"status", "controllers", "policies", "config", "calibrations"}
"""Operations without an effect, which a client sends again after its connection was lost."""
DIRECT_OPERATIONS = ("estop", "stop", "status")
"""Operations that fishd also carries out without its gateways, at sockets of its own."""
MOVING_OPERATIONS = {"set-controller", "clear-fault", "calibrate-servo"}
"""Operations that may move a fish at rest, or start the pulses of its servo."""
MAX_WAIT_S = 5.0
"""Maximum time that such an operation waits before it is refused: its client may have given up
[s]."""

RequestId = int | Annotated[str, Meta(max_length=256)] | None

Line = Annotated[str, Meta(max_length=1000, pattern=PRINTABLE)]
"""Text that goes into logs and terminals: one line without control characters."""


class Request(Struct, forbid_unknown_fields=True):
    """Request of a client."""

    v: Annotated[int, note("Version of this protocol: 2.")]
    op: Annotated[str, note("Name of the operation.", max_length=64)]
    id: Annotated[RequestId, note("Identifier that the reply repeats; optional.")] = None
    args: Annotated[
        dict[str, Any], note("Arguments of the operation; optional if it needs none.")
    ] = {}


class OnlyId(Struct):
    """Request of which only the id is decoded."""

    id: RequestId = None


class Failure(Struct, frozen=True):
    """Error of a refused request."""

    code: Annotated[str, note("One of the codes below.")]
    message: Annotated[str, note("Explanation in one line, with a remedy.")]


class Reply(Struct, frozen=True):
    """Reply: `result` if `ok`, else `error`."""

    v: Annotated[int, note("Version of this protocol: 2.")]
    id: Annotated[RequestId, note("The id of the request; null if it cannot be read.")]
    ok: Annotated[bool, note("Whether the request was carried out.")]
    result: Annotated[msgspec.Raw | UnsetType, note("Result of the operation.")] = UNSET
    error: Annotated[Failure | UnsetType, note("Reason of the refusal.")] = UNSET


class State(Struct, frozen=True):
    """Result of every request that changes something."""

    seq: Annotated[int, note("Number of the first tick that is affected.")]
    mode: Annotated[str, note(MODES)]
    reason: Annotated[Reason | None, note("Reason of mode fault or estop; else null.")]
    controller: Annotated[str, note("The active controller.")]
    parameters: Annotated[dict[str, Any], note("All parameters of the controller.")]
    previous_holder: Annotated[
        LeaseHolder | None,
        note("The experiment whose [lease](#leases) this request has ended; null if none."),
    ] = None
    cancelled: Annotated[
        str | None,
        note("The controller of `start` that `stop` has kept from starting; null if none."),
    ] = None


class Grant(Struct, frozen=True):
    """Result of take-lease."""

    lease: Annotated[str, note("Identifier of the lease for the requests of its holder.")]
    seconds: Annotated[float, unit("s", "Duration of the lease from each renewal on.")]
    previous_holder: Annotated[
        LeaseHolder | None, note("The previous holder, if the fish was taken from one; else null.")
    ] = None


class PolicyInfo(Struct, frozen=True, kw_only=True):
    """A policy file, found by its name or its path."""

    name: str
    file: str
    """Path of the file."""
    problem: str
    """Reason why the policy cannot be used, in one line; empty if it can."""
    card: dict[str, Any] | None
    """Metadata in the file, as JSON; None if it is not a policy file."""
    inputs: str = ""
    """Inputs of the policy: `forces`, `pictures` or `forces, pictures`."""


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
    """Arguments of tare: the `number` of a sample of at most the age `MAX_SAMPLE_AGE_S`."""

    sample: int
    lease: str | None = None


class CalibrateForce(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of calibrate-force."""

    calibration: ForceCalibration
    lease: str | None = None


class CalibrateServo(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of calibrate-servo; without `save`, the calibration is dropped with the lease."""

    calibration: ServoCalibration
    save: bool = False
    lease: str | None = None


class CalibrateThrust(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of calibrate-thrust: thrust [N] over the mean square of `fin_velocity`."""

    factor: Annotated[float, Meta(ge=1e-9, le=1e9)]
    factor_ci95: Annotated[float, Meta(ge=1e-12, le=1e9)]
    """Half-width of the 95 % confidence interval of `factor` [N]."""


class TakeLease(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of take-lease."""

    name: Annotated[str, Meta(min_length=1, max_length=60, pattern=PRINTABLE)]
    """Name of the experiment in messages, such as `measure`."""
    host: Annotated[str, Meta(max_length=64, pattern=PRINTABLE)] = ""
    """Name of the machine on which it runs."""
    pid: int = 0
    """Process id of the experiment; 0 if unknown."""
    seconds: Annotated[float, Meta(ge=MIN_LEASE_S, le=MAX_LEASE_S)] | None = None
    """Duration of the lease without a renewal [s]; None for the configured one."""
    take: bool = False
    """Whether to take the fish from another holder."""


class HeldLease(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of renew-lease and end-lease."""

    lease: str


class Calibrations(Struct, frozen=True):
    """The active calibrations and their files."""

    force: Annotated[ForceCalibration, note("Calibration of the force sensor, see below.")]
    force_file: Annotated[str | None, note("File of `force`; null if the configuration sets it.")]
    servo: Annotated[
        ServoCalibration,
        note("`trim` [µs], `direction`, `scale` [µs/rad], `lowest`, `highest` [rad], `date`."),
    ]
    servo_file: Annotated[str | None, note("File of `servo`; null if the configuration sets it.")]
    force_limit: Annotated[
        float, unit("N", "Limit of a plausible force, either sign: `force_sensor.force_limit`.")
    ]
    on_trial: Annotated[
        bool, note("True while the servo calibration is on trial, under a [lease](#leases).")
    ] = False


class Mark(Struct, frozen=True, forbid_unknown_fields=True):
    """Arguments of mark."""

    text: Line


class Operation(NamedTuple):
    """An operation of the protocol."""

    arguments: type[Struct]
    result: str
    """Description of the result for docs/reference/protocol.md."""
    does: str
    """Description of the effect, likewise."""


_STATE = "[state](#state)"
_CALIBRATIONS = "[calibrations](#calibrations)"
_CONFIG = (
    "the [configuration](configuration.md) that `fishd` was started with, one object per section"
)
OPERATIONS = {
    "status": Operation(NoArguments, "[status](#status)", "nothing"),
    "controllers": Operation(NoArguments, "list of [controllers](#controllers)", "nothing"),
    "policies": Operation(NoArguments, "list of [policies](#policies)", "nothing"),
    "config": Operation(NoArguments, _CONFIG, "nothing"),
    "set-controller": Operation(
        SetController, _STATE, "activates a new controller; omitted parameters take their defaults"
    ),
    "set-parameter": Operation(
        SetParameter, _STATE, "changes these parameters of the active controller, all or none"
    ),
    "stop": Operation(Stop, _STATE, "fades to neutral; mode idle. In fault and estop: nothing"),
    "estop": Operation(Estop, _STATE, "stops the pulses at once; mode estop"),
    "clear-fault": Operation(
        NoArguments, _STATE, "leaves mode fault or estop for idle. Otherwise: nothing"
    ),
    "restart": Operation(
        NoArguments,
        _STATE,
        "fades to neutral and ends; systemd starts `fishd` again, unless an emergency stop comes "
        "meanwhile. Refused while a controller runs or a lease is held, in mode estop, without "
        "systemd, or if the configuration, a calibration or a key is wrong now",
    ),
    "take-lease": Operation(
        TakeLease,
        "[lease](#leases)",
        "reserves the fish for the client while it renews the lease; moves nothing",
    ),
    "renew-lease": Operation(HeldLease, _STATE, "restarts the full duration of the lease"),
    "end-lease": Operation(
        HeldLease, _STATE, "ends the lease, and fades to neutral if a controller was set under it"
    ),
    "mark": Operation(Mark, _STATE, "publishes an event `mark`"),
    "calibrations": Operation(NoArguments, _CALIBRATIONS, "nothing"),
    "sample-force": Operation(
        SampleForce, "[force sample](#calibrations)", "measures for `seconds`"
    ),
    "tare": Operation(
        Tare,
        _CALIBRATIONS,
        f"takes the force sample of that `number`, at most {MAX_SAMPLE_AGE_S:g} s old, as zero; "
        "saved",
    ),
    "calibrate-force": Operation(
        CalibrateForce,
        _CALIBRATIONS,
        "saves it and uses it from the next tick on; omitted fields take their defaults",
    ),
    "calibrate-servo": Operation(
        CalibrateServo,
        _CALIBRATIONS,
        "uses it from the next tick on: saved, or else until the [lease](#leases) ends",
    ),
    "calibrate-thrust": Operation(
        CalibrateThrust,
        _STATE,
        "uses this measured factor for the displayed thrust until fishd ends",
    ),
}
"""All operations, by name."""

encode = msgspec.json.Encoder().encode
decode_reply: Callable[[bytes], Reply] = decoder(Reply)
_decode_request: Callable[[bytes], Request] = decoder(Request)
_decode_id: Callable[[bytes], OnlyId] = decoder(OnlyId)


def decode_request(payload: bytes) -> Request:
    """Decode a request; raise `Refused` with code `bad-request` or `version`.

    An emergency stop is the same in all versions, and accepted from a client of any.
    """
    try:
        request = _decode_request(payload)
    except msgspec.DecodeError as error:
        raise Refused("bad-request", f"not a request: {error}") from None
    if request.v != VERSION and request.op != "estop":
        raise Refused(
            "version",
            f"protocol version {request.v} is not supported, {VERSION} is needed: install the same "
            "version of fishd for daemon and client",
        )
    return request


def request_id(payload: bytes) -> RequestId:
    """Return the id of a request that may otherwise be invalid; None if it cannot be read."""
    try:
        return _decode_id(payload).id
    except msgspec.DecodeError:
        return None


def success(identity: RequestId, result: Any) -> bytes:
    """Encode a reply with a result."""
    return encode(Reply(v=VERSION, id=identity, ok=True, result=msgspec.Raw(encode(result))))


def failure(identity: RequestId, error: Refused) -> bytes:
    """Encode a reply with an error."""
    why = Failure(text.quoted(error.code), text.error_message(error))
    return encode(Reply(VERSION, identity, ok=False, error=why))
