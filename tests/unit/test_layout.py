"""The rooms of fishd/: few of them, each with a purpose, named alike wherever they are named."""

import re
import tomllib
from email import message_from_bytes
from pathlib import Path
from zipfile import ZipFile

import pytest
from hatchling.build import build_wheel
from rigs.documents import ROOT, text_of

from rooms import arrows, purpose, rooms

ROOMS = rooms()
MOST_ROOMS, MOST_ARROWS = 15, 70


def test_fishd_has_few_rooms() -> None:
    assert len(ROOMS) <= MOST_ROOMS


@pytest.mark.parametrize("name", ROOMS)
def test_a_room_says_what_it_is_for_in_one_sentence(name: str) -> None:
    assert re.fullmatch(r"[A-Z][^\n]+[^.]\.", purpose(ROOMS[name]))


def test_the_readme_lists_every_room_with_its_own_words() -> None:
    house = text_of(ROOT / "README.md").partition("\n## The house\n")[2].partition("\n## ")[0]
    listed = dict(re.findall(r"^\| `([^`]+)` \| (.+?) \|$", house, re.MULTILINE))
    assert listed == {name: purpose(path) for name, path in ROOMS.items()}


def test_the_checked_layers_are_the_rooms() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    layers = next(contract for contract in contracts if contract["type"] == "layers")
    named = [room.strip() for layer in layers["layers"] for room in layer.split(":")]
    named += layers["exhaustive_ignores"]
    assert sorted(named) == sorted(path.stem for path in ROOMS.values())


def test_a_wheel_names_its_licence_and_carries_its_text(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    with ZipFile(tmp_path / build_wheel(str(tmp_path))) as wheel:
        files = {name.partition(".dist-info/")[2]: name for name in wheel.namelist()}
        metadata = message_from_bytes(wheel.read(files["METADATA"]))
        licence = wheel.read(files["licenses/LICENSE"]).decode()
    assert (metadata["License-Expression"], metadata["License-File"]) == ("MIT", "LICENSE")
    assert licence.startswith("MIT License\n\nCopyright (c) 2026 The fishd authors\n")


@pytest.mark.slow
def test_few_arrows_run_between_the_rooms() -> None:
    assert len(arrows()) <= MOST_ARROWS
