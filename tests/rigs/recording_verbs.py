"""Runs of the verbs that read recordings on files of any kind, and checks of their results."""

import time
import traceback
from pathlib import Path

from msgspec import Struct

from common.in_process import fishctl
from fishd.recording import replay

VERBS = {
    "runs": "runs --folder {parent}",
    "runs --json": "runs --json --folder {parent}",
    "export --csv": "export {file} --csv --to {out} --force",
    "export --parquet": "export {file} --parquet --to {out} --force",
    "plot": "plot {file} --to {out} --force",
    "rerun": "rerun {file}",
    "replay": "replay {file} --speed 1000 --address ipc://{out}/t --control ipc://{out}/c",
    "recover": "recover {file}",
}
"""Arguments of fishctl, by verb."""
MAX_SECONDS, MAX_MEGABYTES = 10.0, 300.0
"""Largest processor time [s] and memory [MB] of a verb for a short file of any content."""


class Outcome(Struct, frozen=True):
    """Result of a verb."""

    verb: str
    file: str
    status: int | None
    """Exit status; None where an exception escaped."""
    out: str
    err: str
    seconds: float
    """Processor time."""


def run_verb(verb: str, file: Path, out: Path) -> Outcome:
    """Run a verb on a file in this process; out: folder for its output."""
    words = [word.format(file=file, parent=file.parent, out=out) for word in VERBS[verb].split()]
    replay.SUBSCRIBER_WAIT_S = 0.0  # without a subscriber
    begun = time.process_time()
    status, printed, error = None, "", ""
    try:
        done = fishctl(*words)
        status, printed, error = done.returncode, done.stdout, done.stderr
    except Exception:
        error = traceback.format_exc()
    return Outcome(verb, file.name, status, printed, error, time.process_time() - begun)


def find_mistakes(outcome: Outcome) -> list[str]:
    """Return the mistakes in the result of a verb."""
    lines = outcome.err.splitlines()
    mistakes = []
    if outcome.status not in (0, 1):
        mistakes.append(f"status {outcome.status}")
    if outcome.status == 1 and not (lines or outcome.out):
        mistakes.append("failed without a word")
    if len(lines) > 2 or not all(outcome.file in line for line in lines):
        mistakes.append("not one line that names the file")
    if any(not letter.isprintable() for letter in (outcome.out + outcome.err).replace("\n", "")):
        mistakes.append("control characters")
    if outcome.seconds > MAX_SECONDS:
        mistakes.append(f"took {outcome.seconds:.0f} s of processor time")
    return mistakes


def peak_memory() -> float:
    """Return the peak memory of this process [MB]."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024
