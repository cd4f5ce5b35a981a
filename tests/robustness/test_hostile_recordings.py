"""Every verb ends with one line that names the file, for every hostile file."""

import json
import os
import random
import re
import shutil
import sys
from contextlib import suppress
from pathlib import Path

import msgspec
import pytest
from rigs import hostile_verbs
from rigs.damaged_recordings import KINDS
from rigs.documents import ROOT
from rigs.hostile_recordings import FILES
from rigs.hostile_verbs import Result, write_all
from rigs.recording_verbs import MAX_MEGABYTES, VERBS, Outcome, find_mistakes, run_verb

from common.processes import call
from fishd.core.errors import FishdError
from fishd.lab.run_traces import traces
from fishd.recording import open_run

DAMAGED_FILES = int(os.environ.get("DAMAGED_FILES", "12"))
"""Number of damaged recordings; docs/reference/reliability.md has the result of 10000."""
GROUPS = (
    ("runs", "runs --json", "rerun", "replay", "recover", "export --csv", "export --parquet"),
    ("plot",),
)
"""Groups of verbs that share a process and its modules."""
SAID = {
    ("export --csv", "zstd-chunk-of-8-gb"): "20 ticks lost (a chunk claims 8192 MB, 64 MB at most)",
    ("export --csv", "zstd-frame-of-8-gb"): "20 ticks lost (a zstd frame claims 8589934592 bytes,",
    ("export --csv", "lz4-frame-of-8-gb"): "20 ticks lost",
    ("export --csv", "chunks-of-zeros"): "more than 100 times the length of the file",
    ("export --csv", "frame-without-data"): "the picture of frame 9 is empty",
    ("export --csv", "frame-with-damaged-pixels"): "the picture of frame 9 is damaged",
    ("export --csv", "frame-of-4-gb"): "claims 65535 x 65535 px, 16777216 pixels at most",
    ("export --csv", "ten-thousand-quantities"): "more than 100 quantities, too many for a table",
    ("export --parquet", "aliases"): "line 1: more than 2000 values and keys",
    ("export --parquet", "a-number-of-400-digits"): "cannot be written as Parquet",
    ("rerun", "deep-yaml"): "longer than 64 kB",
    ("rerun", "deep-but-short-yaml"): "line 1: nested too deeply",
    ("rerun", "yaml-that-contains-itself"): "line 1: plant.plant.plant...: nested too deeply",
    ("rerun", "yaml-with-tags"): "tick: a value that is not of the tag 'bool'",
    ("rerun", "yaml-of-bytes"): "not a text in UTF-8",
    ("rerun", "limits-that-are-no-numbers"): "",
    ("rerun", "events-that-do-not-say-what"): "an event 'controller' has no controller",
    ("rerun", "parameters-that-no-controller-has"): "swing",
    ("plot", "numbers-that-no-fish-has"): "is 1e+308 somewhere, which cannot be drawn",
}
"""Parts of the messages of verbs, by file."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hostile")
    write_all(folder)
    return folder


@pytest.fixture(scope="module")
def results(folder: Path) -> dict[tuple[str, str], Outcome]:
    """Return the result of each verb for each file; the memory of each process is checked."""
    root = ROOT
    paths = os.pathsep.join(map(str, (root, root / "tests", root / "tools")))
    outcomes = []
    for verbs in GROUPS:
        command = (sys.executable, hostile_verbs.__file__, str(folder), *verbs)
        done = call(*command, env={**os.environ, "PYTHONPATH": paths}, timeout=600)
        assert done.returncode == 0, done.stderr[-3000:]
        assert done.stderr == ""
        result = msgspec.json.decode(done.stdout, type=Result)
        assert result.megabytes < MAX_MEGABYTES, verbs
        outcomes += result.outcomes
    return {(outcome.verb, outcome.file.removesuffix(".mcap")): outcome for outcome in outcomes}


def test_every_verb_ends_with_a_line_and_little_memory(
    results: dict[tuple[str, str], Outcome],
) -> None:
    wrong = {
        key: (mistakes, outcome.err)
        for key, outcome in results.items()
        if not key[0].startswith("runs") and (mistakes := find_mistakes(outcome))
    }
    assert wrong == {}
    assert {verb for group in GROUPS for verb in group} == set(VERBS)
    for (verb, name), words in SAID.items():
        assert words in results[verb, name].err, (verb, name)


def test_a_bad_file_hides_no_other(folder: Path, results: dict[tuple[str, str], Outcome]) -> None:
    listed, as_json = (value for key, value in results.items() if key[0].startswith("runs"))
    bad = re.findall(r"^fishctl: \S+/(\S+)\.mcap", listed.err, re.MULTILINE)
    assert set(bad) > {"chunks-of-zeros", "empty", "nothing-but-magic"}
    assert listed.err.count("\n") == len(bad)
    good = {recording["name"] for recording in json.loads(as_json.out)}
    assert good | set(bad) == {*FILES, "good"}
    assert not set(bad) & {"good", "aliases", "frame-without-data", "zstd-chunk-of-8-gb"}
    for outcome in (listed, as_json):
        assert outcome.out.replace("\n", "").isprintable()


def test_no_text_in_a_file_is_run(folder: Path, results: dict[tuple[str, str], Outcome]) -> None:
    name = "texts-that-are-commands"
    events = (folder / "export--csv" / name / f"{name}-events.csv").read_text()
    ticks = (folder / "export--csv" / name / f"{name}.csv").read_text()
    assert (events + ticks).replace("\n", "").isprintable()
    assert "\\x1b[31m" in events
    assert "\\x1b[31m" in ticks
    for formula in ("=HYPERLINK(0)", "@SUM(1)", "+1", "-1"):
        assert f",'{formula}," in events


def test_damaged_recordings_are_read_or_refused_in_one_line(folder: Path, tmp_path: Path) -> None:
    content, readable = (folder / "good.mcap").read_bytes(), 0
    file = tmp_path / "files/run.mcap"
    file.parent.mkdir()
    for number in range(DAMAGED_FILES):
        what, damage = list(KINDS.items())[number % len(KINDS)]
        file.write_bytes(damage(random.Random(f"11 {number}"), content))
        for verb in ("runs", "export --csv", "rerun", "replay", "recover"):
            out = tmp_path / "out"
            out.mkdir()
            copy = Path(shutil.copy(file, out)) if verb == "recover" else file
            outcome = run_verb(verb, copy, out)
            shutil.rmtree(out)
            assert find_mistakes(outcome) == [], (number, what, verb, outcome.err)
            readable += verb == "export --csv" and outcome.status == 0
        with suppress(FishdError):
            traces(open_run(file))  # the curves of `plot`
    assert readable > DAMAGED_FILES // 3
