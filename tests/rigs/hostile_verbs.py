"""Runs verbs on every hostile recording, in one process: FOLDER VERB...

Prints how each ended, and the most memory that the process has held, as JSON.
"""

import resource
import shutil
import sys
from pathlib import Path

import msgspec

from common.mcap_records import split, write_good_recording
from common.recording_verbs import Outcome, peak_memory, run_verb
from rigs.hostile_recordings import FILES

MAX_ADDRESSES = 4 * 2**30
"""Limit of what the process may allocate [bytes]."""
DRAWN = {
    "ten-thousand-quantities",
    "texts-that-are-commands",
    "thousands-of-events",
    "numbers-that-no-fish-has",
}
"""Files that are drawn, which takes a second each: the others are read by `plot` as by `export`."""


class Result(msgspec.Struct):
    """How the verbs ended for each file."""

    outcomes: list[Outcome]
    megabytes: float


def write_all(folder: Path) -> None:
    """Write all of them, and a good one, into a folder."""
    good = folder / "good.mcap"
    write_good_recording(good)
    records = split(good.read_bytes())
    for name, make in FILES.items():
        (folder / f"{name}.mcap").write_bytes(make(records))


def main(folder: Path, *verbs: str) -> None:
    """Run each verb once on each file, or on the folder."""
    resource.setrlimit(resource.RLIMIT_AS, (MAX_ADDRESSES, MAX_ADDRESSES))
    outcomes = []
    for verb in verbs:
        for file in sorted(folder.glob("*.mcap")):
            if verb.startswith("plot") and file.stem not in DRAWN:
                continue
            out = folder / verb.replace(" ", "") / file.stem
            out.mkdir(parents=True)
            copy = Path(shutil.copy(file, out)) if verb == "recover" else file
            outcomes.append(run_verb(verb, copy, out))
            if verb.startswith("runs"):  # it reads the folder
                break
    print(msgspec.json.encode(Result(outcomes, peak_memory())).decode())


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
