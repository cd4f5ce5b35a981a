"""The examples of a verb and of a configuration key in contributing.md, on a copy of fishd."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from rigs.documents import FENCE, ROOT, text_of
from rigs.processes import Daemon

PAGE = ROOT / "docs" / "how-to" / "contributing.md"
FISHCTL = "from fishd.__main__ import fishctl; fishctl()"


def apply(section: str, folder: Path) -> None:
    """Apply the Python files and the diffs of a section to the copy in a folder."""
    text = re.split(rf"^## {section}$", text_of(PAGE), flags=re.MULTILINE)[1]
    text = re.split(r"^## ", text, flags=re.MULTILINE)[0]
    for kind, block in FENCE.findall(text):
        first, _, body = block.partition("\n")
        path = folder / first.removeprefix("# ")
        if kind == "python":
            path.write_text(body, encoding="utf-8")
        elif kind == "diff":
            old = [line[2:] for line in body.splitlines() if not line.startswith("+")]
            new = [line[2:] for line in body.splitlines() if not line.startswith("-")]
            path.write_text(replace_lines(text_of(path), old, new), encoding="utf-8")


def replace_lines(source: str, old: list[str], new: list[str]) -> str:
    """Replace lines, indented as in the source."""
    match = re.search(rf"^( *){re.escape(old[0].lstrip())}$", source, re.MULTILINE)
    assert match, old[0]
    indent = " " * (len(match[1]) - len(old[0]) + len(old[0].lstrip()))
    indented = ([f"{indent}{line}".rstrip() for line in lines] for lines in (old, new))
    before, after = ("\n".join(lines) for lines in indented)
    assert source.count(before) == 1
    return source.replace(before, after)


@pytest.mark.slow
def test_the_example_of_a_verb_and_that_of_a_key_work(tmp_path: Path, daemon: Daemon) -> None:
    without = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "fishd", tmp_path / "fishd", ignore=without)
    apply("A verb", tmp_path)
    apply("A configuration key", tmp_path)
    for command, answer in (
        (("--endpoint", daemon.endpoint, "beat"), "0.00 Hz\n"),
        (("simulate", "swing", "--seconds", "20", "--set", "estimator.fy_offset=0.02"), "thrust  "),
    ):
        done = subprocess.run(
            [sys.executable, "-c", FISHCTL, *command],
            env={**os.environ, "PYTHONPATH": str(tmp_path)},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert (done.returncode, done.stderr) == (0, "")
        assert answer in done.stdout
