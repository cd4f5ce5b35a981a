"""Ticks of every controller and replies of fishd, of which `tests/reference` keeps a copy.

`PYTHONPATH=tests python -m rigs.references` writes both files again after a change that is meant.
"""

import asyncio
import csv
import re
import tempfile
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from fishd.controllers.registry import describe
from fishd.core import protocol
from fishd.core.errors import Refused
from fishd.daemon.calibration_requests import CalibrationRequests
from fishd.daemon.requests import Operations
from rigs.documents import ROOT
from rigs.harness import Rig

TICKS, WIRE = ROOT / "tests/reference/ticks.csv", ROOT / "tests/reference/wire.json"
COUNT = 200
"""Number of ticks of each controller."""
RUNS: dict[str, tuple[str, dict[str, Any]]] = {
    "hold": ("hold", {"angle": 0.2}),
    "square": ("square", {}),
    "sine": ("sine", {"frequency": 1.3}),
    "triangle": ("triangle", {"frequency": 2.0}),
    "swing": ("swing", {}),
    "swing C=auto": ("swing", {"C": "auto"}),
    "thrust": ("thrust", {"target": 0.02}),
    "excitation": ("excitation", {}),
}
"""Controllers that need no file and no other process, with parameters."""
COLUMNS = ("phi_c", "fx", "fy", "thrust")
REQUESTS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("set-controller", {"name": "swing", "parameters": {"C": 0.6}}),
    ("set-parameter", {"parameters": {"C": 0.5}}),
    ("take-lease", {"name": "measure", "host": "bench", "pid": 7}),
    ("status", {}),
    ("renew-lease", {"lease": "wrong"}),
    ("mark", {"text": "fed"}),
    ("calibrations", {}),
    ("calibrate-thrust", {"factor": 0.001, "factor_ci95": 0.0001}),
    ("stop", {}),
    ("estop", {}),
    ("set-controller", {"name": "square"}),
    ("clear-fault", {}),
    ("controllers", {}),
    ("set-controller", {"name": "swng"}),
    ("no-such-operation", {}),
)
"""Requests in a row, with a tick between each two."""
VOLATILE = re.compile(r'"(t|version|pid|lease|telemetry|uptime|clock)":("[^"]*"|[\d.e+-]+)')
"""Values that depend on machine, version and time."""


def swim(run: str) -> list[tuple[float, ...]]:
    """Return `COLUMNS` of `COUNT` ticks of a noisy fish, rounded to nine digits."""
    name, parameters = RUNS[run]
    ticks = Rig("tick=0.05", "simulation.noise=0.001").start(name, **parameters).run(COUNT)
    return [tuple(float(f"{getattr(tick, column):.9g}") for column in COLUMNS) for tick in ticks]


def answers() -> list[dict[str, Any]]:
    """Return a tick as published, and each request of `REQUESTS` with its reply."""
    rig = Rig("name=Nemo", "tick=0.05", "simulation.noise=0.001").start("swing")
    tick = rig.run(40)[-1]
    with tempfile.TemporaryDirectory() as folder:
        bench = CalibrationRequests(rig.loop, rig.clock, rig.config, Path(folder))
        operations = Operations(
            rig.loop, rig.clock, bench, rig.config, [describe("hold")], realtime=False
        )
        exchanged = [{"topic": "tick", "message": _steady(protocol.encode(tick))}]
        for op, arguments in REQUESTS:
            reply = asyncio.run(_reply(operations, rig, op, arguments))
            exchanged.append({"request": {op: arguments}, "reply": _steady(reply)})
    return exchanged


async def _reply(operations: Operations, rig: Rig, op: str, arguments: dict[str, Any]) -> bytes:
    """Return the bytes of a reply, and run the tick after it."""
    try:
        return protocol.success(1, await operations.perform(op, arguments))
    except Refused as refusal:
        return protocol.failure(1, refusal)
    finally:
        rig.run()


def _steady(payload: bytes) -> Any:
    return msgspec.json.decode(VOLATILE.sub(r'"\1":"*"', payload.decode()))


def _write() -> None:
    with TICKS.open("w", newline="", encoding="utf-8") as file:
        write = partial(csv.writer, lineterminator="\n")(file).writerows
        write([("run", *COLUMNS)])
        for run in RUNS:
            write([(run, *row) for row in swim(run)])
    lines: Iterable[bytes] = map(msgspec.json.encode, answers())
    WIRE.write_bytes(b"[\n" + b",\n".join(lines) + b"\n]\n")


if __name__ == "__main__":
    _write()
