"""The rules for the rooms of fishd/, so that a newcomer finds the way.

1. Few rooms: their table fits one screen. Merge two before you add one beyond the limit.
2. A room states its purpose in one sentence. If that needs an "and", it may be two rooms.
3. Imports point down the layers of pyproject.toml (import-linter checks it).
4. No module imports another that imports it, directly or through others: each can be read, tested
   and moved without the one above it. Imports inside functions and under TYPE_CHECKING count. An
   import of a module from its package counts as one of both, so a module that the `__init__` of
   its package imports writes `from package.sibling import name`.
5. Few arrows: a change of one room should concern few others. If a new import exceeds the limit,
   move the code to the room that needs it, or pass the object in as an argument.
6. The table in docs/explanation/rooms.md is written by `make docs`.
"""

import json
import re
from email import message_from_bytes
from graphlib import TopologicalSorter
from pathlib import Path
from zipfile import ZipFile

import pytest
from rigs.documents import ROOT
from rigs.wheel import build

import rooms as tool
from common.report import DOCS, between
from rooms import arrows, imports, layers, purpose, rooms

ROOMS = rooms()
MAX_ROOMS = 15
"""Largest number of rooms; the fifteenth, `window`, is a program of its own, as `camera` is."""
MAX_ARROWS_PER_ROOM = 4
"""Largest mean number of other rooms that a room imports."""


def test_fishd_has_few_rooms() -> None:
    assert len(ROOMS) <= MAX_ROOMS


@pytest.mark.slow
def test_a_room_imports_few_others() -> None:
    assert len(arrows()) <= MAX_ARROWS_PER_ROOM * len(ROOMS)


@pytest.mark.slow
def test_no_module_imports_another_that_imports_it() -> None:
    TopologicalSorter(imports()).prepare()  # raises CycleError, which names the modules of a circle


@pytest.mark.parametrize("name", ROOMS)
def test_a_room_says_what_it_is_for_in_one_sentence(name: str) -> None:
    assert re.fullmatch(r"[A-Z][^\n]+[^.]\.", purpose(ROOMS[name]))


def test_the_checked_layers_are_the_rooms() -> None:
    assert sorted(layers()) == sorted(path.stem for path in ROOMS.values())


@pytest.mark.slow
def test_the_page_lists_every_room_with_its_own_words() -> None:
    assert between(DOCS / "explanation" / "rooms.md", "rooms") == tool.summary()


def test_a_wheel_carries_its_licence_and_those_of_the_libraries_in_it(tmp_path: Path) -> None:
    with ZipFile(build(tmp_path)) as wheel:
        files = {name.partition(".dist-info/")[2]: name for name in wheel.namelist()}
        metadata = message_from_bytes(wheel.read(files["METADATA"]))
        licence = wheel.read(files["licenses/LICENSE"]).decode()
    vendor = ROOT / "fishd" / "window" / "page" / "vendor"
    manifest = json.loads((vendor / "manifest.json").read_bytes())
    assert {package["license"] for package in manifest["packages"]} == {"MIT", "Apache-2.0"}
    assert metadata["License-Expression"] == "MIT AND Apache-2.0"
    licences = {str(path.relative_to(ROOT)) for path in vendor.glob("*.LICENSE")}
    assert set(metadata.get_all("License-File", [])) == {"LICENSE", *licences}
    assert {f"licenses/{path}" for path in licences} <= files.keys()
    assert licence.startswith("MIT License\n\nCopyright (c) 2026 The fishd authors\n")
