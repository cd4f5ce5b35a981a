"""A daemon that would talk to the terminal: fishctl prints nothing of it but printable text."""

import json
import os
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq
from processes import FISHCTL, PATIENCE

from fishd import protocol
from fishd.hardware.calibration import ForceCalibration, ServoCalibration
from fishd.policies.info import PolicyInfo
from fishd.protocol import Calibrations, State
from fishd.schema import Field
from fishd.signals import ControllerInfo, Percentiles, Reason, Status, Tick, Timing

EVIL = "\x1b[2J\x9b31m\x07\u202e\r\nfishctl: forged\x00"
"""Clears the screen, changes colours, rings, turns the text round, and forges a line."""
REASON = Reason(EVIL, EVIL)
LATE = Percentiles(1.0, 2.0, 3.0, 4)
STATE = State(1, EVIL, REASON, EVIL, {EVIL: EVIL})
FIELD = Field(EVIL, "number", EVIL, EVIL, EVIL, EVIL, False)


def status(telemetry: str) -> Status:
    return Status(
        t=0.0,
        version=EVIL,
        pid=1,
        uptime=1.0,
        mode=EVIL,
        reason=REASON,
        controller=EVIL,
        parameters={EVIL: EVIL},
        servo_on=True,
        thrust=0.0,
        frequency=0.0,
        tick=0.05,
        amplitude_limit=0.42,
        lowest=-0.42,
        highest=0.42,
        seq=1,
        missed=0,
        overruns=0,
        timing=Timing(LATE, LATE, {EVIL: LATE}),
        robot=EVIL,
        degraded=(EVIL,),
        counters={EVIL: 1},
        realtime=True,
        telemetry=telemetry,
        servo_lost=False,
        sensor_lost=False,
        calibrating=True,
    )


class Hostile:
    """Answers every request, and publishes, with what no terminal should see."""

    def __init__(self, folder: Path) -> None:
        self.endpoint = f"ipc://{folder}/control"
        self._telemetry = f"ipc://{folder}/telemetry"
        self._over = threading.Event()
        self.refuses = False
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
                telemetry.send_multipart((b"tick", msgspec.json.encode(self._tick(seq))))
                if control.poll(20):
                    *envelope, payload = control.recv_multipart()
                    control.send_multipart([*envelope, self._answer(payload)])

    @staticmethod
    def _tick(seq: int) -> Tick:
        figures = dict.fromkeys(("fx", "fy", "fy_rate", "fin_velocity", "phi_c", "thrust"), 0.0)
        times = dict.fromkeys(("t", "frequency", "age_ms", "lateness_us", "busy_us"), 0.0)
        return Tick(
            seq=seq, mode=EVIL, controller=EVIL, servo_on=True, samples=1, missed=0,
            **figures, **times,
        )  # fmt: skip

    def _answer(self, payload: bytes) -> bytes:
        request = protocol.decode_request(payload)
        if self.refuses:
            failure = protocol.Failure(EVIL, EVIL)
            return protocol.encode(protocol.Reply(1, request.id, ok=False, error=failure))
        calibrations = Calibrations(ForceCalibration(), EVIL, ServoCalibration(), EVIL, 10.0)
        results: dict[str, Any] = {
            "status": status(self._telemetry),
            "controllers": [ControllerInfo(EVIL, EVIL, (FIELD,)), ControllerInfo("evil", EVIL, ())],
            "policies": [PolicyInfo(name=EVIL, file=EVIL, card=None, problem=EVIL)],
            "calibrations": calibrations,
        }
        return protocol.success(request.id, results.get(request.op, STATE))


@pytest.fixture
def hostile(tmp_path: Path) -> Iterator[Hostile]:
    daemon = Hostile(tmp_path)
    yield daemon
    daemon.close()


def fishctl(hostile: Hostile, *arguments: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [FISHCTL, "--endpoint", hostile.endpoint, *arguments],
        capture_output=True,
        check=False,
        timeout=PATIENCE,
        env={**os.environ, "FISHD_CONFIG": "", "PYTHONUTF8": "1"},
    )


def check(output: bytes) -> None:
    """Nothing but printable text, and no line that fishctl has not begun."""
    assert all(line.isprintable() for line in output.decode().split("\n"))
    assert "\nfishctl: forged" not in output.decode()


VERBS = (
    ("status",),
    ("controllers",),
    ("policies",),
    ("set-controller", "evil"),
    ("set-controller", "evil", "--help"),
    ("set-parameter", "C", "0.7"),
    ("stop",),
    ("estop",),
    ("clear-fault",),
    ("mark", "now"),
    ("watch", "--seconds", "1"),
    ("watch", "--json", "--seconds", "1"),
    ("doctor",),
    ("tare",),
)


@pytest.mark.parametrize("verb", VERBS, ids=" ".join)
def test_no_answer_says_anything_to_the_terminal(hostile: Hostile, verb: tuple[str, ...]) -> None:
    done = fishctl(hostile, *verb)
    check(done.stdout)
    check(done.stderr)
    assert b"Traceback" not in done.stderr
    assert done.stdout + done.stderr


@pytest.mark.parametrize("verb", [verb for verb in VERBS if verb[0] != "doctor"], ids=" ".join)
def test_no_refusal_says_anything_to_the_terminal(hostile: Hostile, verb: tuple[str, ...]) -> None:
    hostile.refuses = True
    done = fishctl(hostile, *verb)
    check(done.stdout)
    check(done.stderr)
    assert done.stderr.count(b"\n") == 1
    assert b"forged" in done.stderr or b"evil" in done.stderr


@pytest.mark.parametrize("verb", ["status", "controllers", "policies", "stop"])
def test_as_json_all_of_it_is_there_and_escaped(hostile: Hostile, verb: str) -> None:
    done = fishctl(hostile, verb, "--json")
    check(done.stdout)
    assert EVIL in set(texts(json.loads(done.stdout)))


def texts(value: Any) -> Iterator[str]:
    """All texts in a document."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from texts(part)
