"""The decoder of requests: whatever arrives becomes a request or a refusal."""

from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs.harness import Rig

from fishd.core import protocol
from fishd.core.errors import Refused
from fishd.daemon.calibration_requests import CalibrationRequests
from fishd.daemon.requests import Operations

json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=10,
)


def decode_request(payload: bytes) -> protocol.Request | Refused:
    try:
        return protocol.decode_request(payload)
    except Refused as refusal:
        return refusal


@given(st.binary(max_size=200))
def test_any_bytes_become_a_request_or_a_refusal(payload: bytes) -> None:
    assert isinstance(decode_request(payload), protocol.Request | Refused)
    protocol.request_id(payload)


@settings(max_examples=40)
@given(json_values)
def test_any_json_becomes_a_request_or_a_refusal(value: object) -> None:
    assert isinstance(decode_request(msgspec.json.encode(value)), protocol.Request | Refused)


@settings(max_examples=40)
@given(
    st.text(max_size=64),
    st.integers(-(2**63), 2**63 - 1) | st.text(max_size=256),
    st.dictionaries(st.text(), json_values, max_size=3),
)
def test_a_request_arrives_as_sent(op: str, identity: int | str, args: dict[str, object]) -> None:
    wire = {"v": 2, "op": op, "id": identity, "args": args}
    request = protocol.decode_request(msgspec.json.encode(wire))
    assert (request.op, request.id, request.args) == (op, identity, args)


def test_another_version_is_refused_by_name() -> None:
    with pytest.raises(Refused, match="version 3 is not supported, 2 is needed") as caught:
        protocol.decode_request(b'{"v":3,"op":"status"}')
    assert caught.value.code == "version"
    assert protocol.decode_request(b'{"v":1,"op":"estop"}').op == "estop"


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"[]",
        b'{"v":2}',
        b'{"v":2,"op":7}',
        b'{"v":2,"op":"status","args":[]}',
        b'{"v":2,"op":"status","speed":3}',
        b'{"v":2,"op":"set-controller","args":{"name":"swing","parameters":{"C":NaN}}}',
        b"[" * 60_000,
    ],
)
def test_a_malformed_request_is_refused_as_such(payload: bytes) -> None:
    with pytest.raises(Refused) as caught:
        protocol.decode_request(payload)
    assert caught.value.code == "bad-request"


def test_the_id_of_a_broken_request_is_found_where_there_is_one() -> None:
    assert protocol.request_id(b'{"id": 7, "op": 3}') == 7
    assert protocol.request_id(b'{"id": [7]}') is None
    assert protocol.request_id(b"\x00") is None


def test_what_the_protocol_lists_is_what_fishd_answers(tmp_path: Path) -> None:
    rig = Rig()
    bench = CalibrationRequests(rig.loop, rig.clock, rig.config, tmp_path)
    operations = Operations(rig.loop, rig.clock, bench, rig.config, [], realtime=False)
    assert [*operations._handlers] == [*protocol.OPERATIONS]
