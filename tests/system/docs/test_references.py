"""The references in docs/ and the programs that write them."""

import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest
from rigs.documents import ROOT

from fishd.config import Config, load
from fishd.core.errors import ConfigError
from fishd.core.schema import list_keys
from fishd.core.signals import EVENTS, EventKind

REFERENCE = (ROOT / "docs" / "reference" / "configuration.md").read_text(encoding="utf-8")


def test_the_committed_configuration_reference_is_what_the_schema_says() -> None:
    program = [sys.executable, str(ROOT / "tools" / "config_reference.py"), "--check"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_configuration_reference_names_every_key() -> None:
    missing = [key for key in list_keys(Config) if f"`{key}`" not in REFERENCE]
    assert not missing


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


@pytest.mark.parametrize("tool", ["protocol_reference.py", "verb_reference.py"])
def test_the_committed_tables_are_what_the_code_says(tool: str) -> None:
    program = [sys.executable, str(ROOT / "tools" / tool), "--check"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("words", [["bench"], ["bench", "swimmer"], ["reliability"]])
def test_the_help_of_a_program_lists_what_it_measures(words: list[str]) -> None:
    program = [sys.executable, str(ROOT / "tools" / words[0]), *words[1:], "--help"]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert {"bench": "coverage", "swimmer": "cylinder", "reliability": "kills"}[words[-1]] in (
        done.stdout
    )


def test_every_kind_of_event_is_described() -> None:
    assert {kind for kind, *_ in EVENTS} == set(get_args(EventKind))
