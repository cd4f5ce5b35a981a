"""Program that runs verbs on every hostile recording in one process: FOLDER VERB...

It prints how each ended, and the peak memory of the process, as JSON.
"""

import resource
import shutil
import sys
from pathlib import Path

import msgspec

from rigs.hostile_recordings import FILES
from rigs.mcap_records import split, write_good_recording
from rigs.recording_verbs import Outcome, peak_memory, run_verb

MAX_ADDRESSES = 4 * 2**30
"""Limit of the address space of the process [bytes]."""
TEXTS_AND_NUMBERS = {"texts-that-are-commands", "numbers-that-no-fish-has"}
LARGE_RECORDINGS = {"ten-thousand-quantities", "thousands-of-events"}
FILES_OF = {
    "export --parquet": {
        "aliases",
        "a-number-of-400-digits",
        "good",
        *TEXTS_AND_NUMBERS,
        *LARGE_RECORDINGS,
    },
    "plot": {*TEXTS_AND_NUMBERS, *LARGE_RECORDINGS},
}
"""Files for a verb; it reads the others like `export --csv`.
"""


class Result(msgspec.Struct):
    """Results of the verbs for each file."""

    outcomes: list[Outcome]
    megabytes: float


def write_all(folder: Path) -> None:
    """Write all hostile files and a good one into a folder."""
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
            if file.stem not in FILES_OF.get(verb, (file.stem,)):
                continue
            out = folder / verb.replace(" ", "") / file.stem
            out.mkdir(parents=True)
            copy = Path(shutil.copy(file, out)) if verb == "recover" else file
            outcomes.append(run_verb(verb, copy, out))
            if verb.startswith("runs"):  # the verb reads the folder
                break
    print(msgspec.json.encode(Result(outcomes, peak_memory())).decode())


if __name__ == "__main__":
    main(Path(sys.argv[1]), *sys.argv[2:])
