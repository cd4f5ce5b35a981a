"""Recordings on a disk that becomes full, read-only or stalls at a random instant; needs root.

`fishctl record` runs on a small disk of its own. Afterwards its file must hold the ticks that it
says are stored, without a gap that is not counted, and after a failure it must not be called
complete. Each tick that fishd had published until the
trouble, or until the end after a stall, must be stored or counted as lost. An exit status of 0
means that nothing was lost.
"""

import json
import random
import tempfile
import time
from argparse import Namespace
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from msgspec import Struct

from common.daemon import Fishd
from common.processes import FISHCTL, Process, wait_until
from common.report import Options, Report, progress, table
from common.small_disk import small_disk
from fishd.core.errors import RecordingError
from fishd.recording import open_run

TROUBLES = ("full", "read-only", "stalled")
MAX_AGE_S = 3.0
"""Longest time from the first stored tick to the trouble [s]."""
MAX_STALL_S = 3.0
PARALLEL = 4
"""Number of recordings at a time."""


class Trial(Struct):
    """One recording, and what it said."""

    trouble: str
    status: int
    stored: int
    """Number of ticks in the file."""
    gaps: int
    """Number of ticks that are missing between the stored ones."""
    published: int
    """Number of ticks from the first stored one that fishd has certainly published."""
    said_stored: int
    said_lost: int
    said_complete: bool

    @property
    def is_silent(self) -> bool:
        """Whether ticks are missing that the recorder did not count."""
        missing = max(self.gaps, self.published - self.stored)
        is_wrong = self.stored != self.said_stored or self.said_lost < missing
        return is_wrong or self.said_complete != (self.status == 0 and not self.said_lost)


def run(trouble: str, age: float, stall: float) -> Trial:
    """Record a fish until the disk has its trouble, or for a while after a stall.

    age: time from the first stored tick to the trouble [s]
    stall: duration of a stall [s]
    """
    with (
        tempfile.TemporaryDirectory(prefix="fishd-") as name,
        small_disk(Path(name)) as disk,
        Fishd("realtime.priority=0") as fishd,
    ):
        fishd.next_tick()
        words = ("record", "run", "--folder", str(disk.folder), "--json")
        with Process(FISHCTL, "--endpoint", fishd.endpoint, *words) as recorder:
            part = disk.folder / "run.mcap.part"
            wait_until(lambda: _has_ticks(part))
            time.sleep(age)
            published = fishd.status().seq
            if trouble == "stalled":
                with disk.stalled():
                    time.sleep(stall)
                time.sleep(2.0)
                published = fishd.status().seq
                status, out, _ = recorder.end()
            else:
                (disk.fill if trouble == "full" else disk.make_read_only)()
                status, out, _ = recorder.finish()
        said = json.loads(out)
        path = disk.folder / "run.mcap"
        ticks = [tick.seq for tick in open_run(path if path.exists() else part).ticks]
    gaps = ticks[-1] - ticks[0] + 1 - len(ticks)
    published -= ticks[0] - 1
    stored, lost, is_complete = said["ticks"], said["lost_ticks"], said["complete"]
    return Trial(trouble, status, len(ticks), gaps, published, stored, lost, is_complete)


def _has_ticks(path: Path) -> bool:
    try:
        return bool(open_run(path).ticks)
    except RecordingError:
        return False


OPTIONS: Options = {
    "--number": {"type": int, "default": 20, "help": "of recordings for each trouble; default 20"},
    "--seed": {"type": int, "default": 1, "help": "default 1"},
}


def measure(options: Namespace) -> Report:
    """Record on small disks; three minutes."""
    chance = random.Random(options.seed)
    cases = [
        (trouble, chance.uniform(0.0, MAX_AGE_S), chance.uniform(0.5, MAX_STALL_S))
        for _ in range(options.number)
        for trouble in TROUBLES
    ]
    with ThreadPoolExecutor(PARALLEL) as pool:
        trials = list(pool.map(lambda case: run(*case), cases))
    for trial in trials:
        progress(f"{trial}")
    rows = []
    for trouble in TROUBLES:
        own = [trial for trial in trials if trial.trouble == trouble]
        statuses = sorted({trial.status for trial in own})
        rows.append(
            [
                trouble,
                f"{len(own)}",
                f"{sum(trial.stored for trial in own)}",
                f"{sum(trial.said_lost for trial in own)}",
                ", ".join(map(str, statuses)),
                f"{sum(trial.is_silent for trial in own)}",
            ]
        )
    head = "disk | recordings | ticks stored | counted as lost | exit status | silent losses"
    silent = sum(trial.is_silent for trial in trials)
    result = f"{silent} silent losses in {len(trials)} recordings"
    text = f"{table(head, rows)}\n\nSeed {options.seed}."
    return Report({"reliability disks": text}, trials, broken=silent > 0, number=result)
