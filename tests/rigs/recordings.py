"""Recordings of virtual fish."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fishd.core.signals import Percentiles, Status, Tick, Timing
from fishd.recording import RunWriter
from rigs.harness import Rig


def swum(seconds: float = 3.0, *overrides: str) -> Rig:
    """Return a rig with a virtual fish that has swum and was retuned meanwhile."""
    rig = Rig(*overrides).start("swing")
    rig.run_for(seconds / 2)
    rig.retune(C=0.3)
    rig.run_for(seconds / 2)
    return rig


def record_run(rig: Rig, path: Path, *, flush_every: int = 1000, **about: Any) -> Path:
    """Return the published messages of the rig, in their order."""
    with RunWriter(path, **about) as writer:
        writer.describe(rig.config)
        for number, message in enumerate(rig.recorder.messages):
            (writer.tick if isinstance(message, Tick) else writer.event)(message)  # type: ignore[arg-type]
            if number % flush_every == 0:
                writer.flush()
    return writer.path


def write(path: Path, ticks: Sequence[Tick]) -> Path:
    """Write a recording of these ticks."""
    with RunWriter(path) as writer:
        writer.describe(Rig().config)
        for tick in ticks:
            writer.tick(tick)
    return writer.path


def status(tick: Tick, pid: int) -> Status:
    """Return the status of a fishd of this process just after a tick."""
    never = Percentiles(0.0, 0.0, 0.0, 0)
    return Status(
        tick.t, "", pid, tick.time, tick.mode, None, tick.controller, {}, tick.servo_on, 0.0, 0.0,
        0.05, 0.42, -0.42, 0.42, tick.seq, 0, 0, Timing(never, never, {}), "simulated", (), {},
        realtime=False, telemetry="",
    )  # fmt: skip
