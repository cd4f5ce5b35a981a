"""The Python examples of the documentation, run without changes, and ended with Ctrl-C."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from rigs.documents import DOCS, FENCE, ROOT, text_of
from rigs.processes import PATIENCE, Daemon


def examples() -> Iterator[object]:
    for document in DOCS:
        blocks = [block for kind, block in FENCE.findall(text_of(document)) if kind == "python"]
        for number, block in enumerate(blocks, 1):
            if "import Fish\n" in block and "fish.ticks()" in block:
                yield pytest.param(block, id=f"{document.name}-{number}")


@pytest.mark.parametrize("block", list(examples()))
def test_an_example_prints_ticks_and_ends_well(block: str, daemon: Daemon, tmp_path: Path) -> None:
    with subprocess.Popen(
        [sys.executable, "-u", "-c", block],
        env={**os.environ, "FISHD_ENDPOINT": daemon.endpoint},
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as example:
        assert example.stdout
        assert example.stdout.readline()
        example.send_signal(signal.SIGINT)
        _, errors = example.communicate(timeout=PATIENCE)
    assert (example.returncode, errors) == (0, "")


def test_there_are_examples_in_the_readme_and_the_tour() -> None:
    assert (ROOT / "README.md") in DOCS
    assert len(list(examples())) >= 2
