"""A daemon that sends control sequences: fishctl prints only printable text."""

import json
import re
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq
from msgspec import inspect
from rigs.processes import PATIENCE, fishctl

from fishd.client import Fish, FishError
from fishd.core import protocol
from fishd.core.protocol import Calibrations, PolicyInfo, State
from fishd.core.signals import ControllerInfo, Status, Tick

EVIL = "\x1b[2J\x9b31m\x07\u202e\r\nfishctl: forged\x00"
"""Text that clears the screen, changes colours, rings, reverses the text, and forges a line."""


def evil(kind: Any, **known: Any) -> Any:
    """Return a value of this type of the protocol with `EVIL` for every text except the `known`."""
    return _evil(inspect.type_info(kind), known)


def _evil(kind: inspect.Type, known: dict[str, Any] | None = None) -> Any:
    match kind:
        case inspect.StructType():
            texts = {field.encode_name: _evil(field.type) for field in kind.fields}
            return texts | (known or {})
        case inspect.Metadata():
            return _evil(kind.type)
        case inspect.UnionType():
            return _evil(next(t for t in kind.types if not isinstance(t, inspect.NoneType)))
        case inspect.ListType() | inspect.VarTupleType():
            return [_evil(kind.item_type)]
        case inspect.TupleType():
            return [_evil(part) for part in kind.item_types]
        case inspect.DictType():
            return {EVIL: _evil(kind.value_type)}
        case inspect.StrType() | inspect.AnyType():
            return EVIL
        case inspect.LiteralType():
            return kind.values[0]
        case inspect.BoolType():
            return True
        case inspect.IntType() | inspect.FloatType():
            return max(1, kind.ge or 0) if kind.le is None else kind.le
    raise AssertionError(kind)


class Hostile:
    """Daemon that answers every request, and publishes, with control sequences."""

    def __init__(self, folder: Path) -> None:
        self.endpoint = f"ipc://{folder}/control"
        self._telemetry = f"ipc://{folder}/telemetry"
        self._over = threading.Event()
        self.refuses = False
        self.rubbish = b""
        """Data that is sent instead of valid answers and messages."""
        self._thread = threading.Thread(target=self._serve)
        self._ready = threading.Event()
        self._thread.start()
        assert self._ready.wait(PATIENCE)

    def close(self) -> None:
        self._over.set()
        self._thread.join(PATIENCE)

    def _serve(self) -> None:
        with (
            zmq.Context() as context,
            context.socket(zmq.ROUTER) as control,
            context.socket(zmq.PUB) as telemetry,
        ):
            control.bind(self.endpoint)
            telemetry.bind(self._telemetry)
            self._ready.set()
            seq = 0
            while not self._over.is_set():
                seq += 1
                tick = self.rubbish or msgspec.json.encode(evil(Tick, seq=seq))
                telemetry.send_multipart((b"tick", tick))
                if control.poll(20):
                    *envelope, payload = control.recv_multipart()
                    control.send_multipart([*envelope, self.rubbish or self._answer(payload)])

    def _answer(self, payload: bytes) -> bytes:
        request = protocol.decode_request(payload)
        if self.refuses:
            failure = protocol.Failure(EVIL, EVIL)
            return protocol.encode(protocol.Reply(2, request.id, ok=False, error=failure))
        infos = [evil(ControllerInfo), evil(ControllerInfo, name="evil", parameters=[])]
        results: dict[str, Any] = {
            "status": evil(Status, telemetry=self._telemetry),
            "controllers": infos,
            "policies": [evil(PolicyInfo, card=None)],
            "calibrations": evil(Calibrations),
        }
        return protocol.success(request.id, results.get(request.op, evil(State)))


@pytest.fixture
def hostile(tmp_path: Path) -> Iterator[Hostile]:
    daemon = Hostile(tmp_path)
    yield daemon
    daemon.close()


def asked(hostile: Hostile, *arguments: str) -> subprocess.CompletedProcess[str]:
    return fishctl("--endpoint", hostile.endpoint, *arguments)


def check(output: str) -> None:
    """Check that the output is printable, and that every line is one of fishctl."""
    assert all(line.isprintable() for line in output.split("\n"))
    assert "\nfishctl: forged" not in output


VERBS = (
    ("status",),
    ("policies",),
    ("set-controller", "evil"),
    ("set-controller", "evil", "--help"),
    ("set-parameter", "C", "0.7"),
    ("estop",),
    ("mark", "now"),
    ("watch", "--seconds", "5"),
    ("doctor",),
    ("tare",),
)


@pytest.mark.parametrize("refuses", [False, True], ids=["answers", "refuses"])
@pytest.mark.parametrize("verb", VERBS, ids=" ".join)
def test_no_answer_and_no_refusal_says_anything_to_the_terminal(
    hostile: Hostile, verb: tuple[str, ...], refuses: bool
) -> None:
    hostile.refuses = refuses
    done = asked(hostile, *verb)
    check(done.stdout)
    check(done.stderr)
    assert "Traceback" not in done.stderr
    assert done.stdout + done.stderr
    if refuses and verb != ("doctor",):
        assert done.stderr.count("\n") == 1
        assert "forged" in done.stderr or "evil" in done.stderr


@pytest.mark.parametrize(
    "rubbish", [b"no JSON", b'{"v":2,"id":"\xff"}', b'{"a":' + 60_000 * b"["], ids=len
)
def test_rubbish_is_one_line_that_says_its_origin(hostile: Hostile, rubbish: bytes) -> None:
    with Fish(hostile.endpoint, timeout=PATIENCE) as fish:
        telemetry = fish.status().telemetry
    hostile.rubbish = rubbish
    where = f"the program at {hostile.endpoint} is not a fishd of this version: "
    with Fish(hostile.endpoint, timeout=PATIENCE, telemetry=telemetry) as fish:
        with pytest.raises(FishError, match=f"^{re.escape(where)}[^\n]+$"):
            fish.status()
        with pytest.raises(FishError, match=f"^{re.escape(where)}[^\n]+$"):
            next(fish.ticks())
    done = asked(hostile, "status")
    assert done.stderr.startswith(f"fishctl: {where}")
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)


@pytest.mark.parametrize("verb", ["status", "controllers"])
def test_as_json_all_of_it_is_there_and_escaped(hostile: Hostile, verb: str) -> None:
    done = asked(hostile, verb, "--json")
    check(done.stdout)
    assert EVIL in set(texts(json.loads(done.stdout)))


def texts(value: Any) -> Iterator[str]:
    """Return all texts in a document."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from texts(part)
