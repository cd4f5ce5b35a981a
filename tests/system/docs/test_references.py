"""The references in docs/ and the programs that write them."""

import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from rigs.documents import ROOT

from fishd.config import load
from fishd.core.errors import ConfigError
from fishd.core.signals import EVENTS, EventKind

DOCS = ROOT / "docs"
REFERENCE = (DOCS / "reference" / "configuration.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("plant:\n  omega: 12\n", "fish.yaml:2: plant.omega: unknown key; did you mean 'omega0'?"),
        ("tick: 1\n", "fish.yaml:1: tick: 1 is not valid: a number in [0.002, 0.2] s is needed"),
        (
            "start:\n  controller: swing\n  parameters:\n    C: 3\n",
            "fish.yaml:4: start.parameters.C: swing: C: 3 is not valid: "
            "a number in [0, 1] (or auto) is needed",
        ),
    ],
    ids=["unknown key", "out of bounds", "parameter of a controller"],
)
def test_the_complaints_in_the_configuration_reference_are_those_of_fishd(
    text: str, line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("fish.yaml").write_text(text)
    with pytest.raises(ConfigError) as refusal:
        load(Path("fish.yaml"))
    assert str(refusal.value) == line
    assert f"fishd: {line}\n" in REFERENCE


@pytest.mark.parametrize("tool", ["config", "protocol", "verb"])
def test_the_committed_tables_are_what_the_code_says(tool: str) -> None:
    program = [sys.executable, str(ROOT / "tools" / f"{tool}_reference.py"), "--check"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("words", [["bench"], ["bench", "accuracy"], ["reliability"]])
def test_the_help_of_a_program_lists_what_it_measures(words: list[str]) -> None:
    program = [sys.executable, str(ROOT / "tools" / words[0]), *words[1:], "--help"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    example = {"bench": "tick", "accuracy": "identify", "reliability": "kills"}[words[-1]]
    assert example in done.stdout


def test_every_kind_of_event_is_described() -> None:
    assert {kind for kind, *_ in EVENTS} == set(get_args(EventKind))


@pytest.mark.parametrize(("kind", "blocks"), [("driver", 5), ("plant", 4)])
def test_a_page_about_an_example_shows_its_code_as_it_is(kind: str, blocks: int) -> None:
    page = (DOCS / "how-to" / f"writing-a-{kind}.md").read_text(encoding="utf-8")
    page = page.partition("\n## A whole robot\n")[0]  # which has no example
    shown = [block.partition("\n") for block in page.split("```")[1::2]]
    code = [body.strip() for language, _, body in shown if language in ("python", "toml")]
    files = [
        path.read_text(encoding="utf-8")
        for folder in DOCS.glob(f"example-{kind}*")
        for path in folder.rglob("*")
        if path.suffix in (".py", ".toml")
    ]
    assert len(code) == blocks
    for block in code:
        assert any(block in file for file in files), block
