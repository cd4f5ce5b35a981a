"""Plug-ins of a table and of other packages: their discovery, and the errors of broken ones."""

import sys
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from zipfile import ZipFile

import pytest
from msgspec import Struct

from fishd.core.errors import FishdError
from fishd.core.plugins import Plugins


class Gadget:
    class Settings(Struct):
        size: int = 0


class Shapeless(Gadget):
    Settings = None  # type: ignore[assignment]


class Unfinished(Gadget, ABC):
    @abstractmethod
    def turn(self) -> None: ...


@pytest.fixture
def gadgets() -> Plugins[Gadget]:
    built_in = {
        "key": f"{__name__}:Gadget",
        "text": "string:digits",
        "shapeless": f"{__name__}:Shapeless",
        "unfinished": f"{__name__}:Unfinished",
        "lost": "nowhere:Lost",
    }
    return Plugins("gadget", "fishd.gadgets", Gadget, "Settings", built_in, FishdError)


@pytest.fixture
def install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Installs a package whose entry_points.txt says so in the group of the gadgets."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def installed(package: str, lines: str) -> None:
        info = tmp_path / f"{package}-1.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[fishd.gadgets]\n{lines}\n")
        (tmp_path / f"{package}.py").write_text(f"from {__name__} import Gadget\n")

    return installed


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("keys", r"^no gadget is named 'keys'; did you mean 'key'\?$"),
        ("text", r"'text' \(string:digits in fishd\) is not a subclass of .*test_plugins\.Gadget$"),
        ("shapeless", r"'shapeless' \(.*:Shapeless in fishd\) has no Settings, a msgspec.Struct$"),
        ("unfinished", r"^gadget 'unfinished' \(.*:Unfinished in fishd\) does not define turn$"),
        ("lost", r"'lost' \(nowhere:Lost in fishd\) does not load: ModuleNotFoundError: No mod"),
    ],
)
def test_what_cannot_be_had_is_explained(gadgets: Plugins[Gadget], name: str, message: str) -> None:
    with pytest.raises(FishdError, match=message):
        gadgets.find(name)


@pytest.mark.slow
def test_packages_are_found_beside_the_built_in_plugins(
    gadgets: Plugins[Gadget], install: Callable[[str, str], None]
) -> None:
    install("broken_package", "this line is not an entry point")
    install("late_package", "late = late_package:Gadget\nkey = late_package:Gadget")
    assert gadgets.names() == ["key", "late", "lost", "shapeless", "text", "unfinished"]
    assert gadgets.find("late") is Gadget
    assert "package broken_package cannot be read" in gadgets.problems["broken_package"]
    assert gadgets.package("late") == "late_package 1.0"
    assert gadgets.package("key") == "fishd", "a built-in plug-in is never replaced"


def test_a_package_in_an_archive_is_found(
    gadgets: Plugins[Gadget], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ZipFile(tmp_path / "packages.zip", "w") as archive:
        archive.writestr("packed-1.0.dist-info/METADATA", "Name: packed\nVersion: 1.0\n")
        line = f"[fishd.gadgets]\npacked = {__name__}:Gadget\n"
        archive.writestr("packed-1.0.dist-info/entry_points.txt", line)
    monkeypatch.syspath_prepend(str(tmp_path / "packages.zip"))
    assert gadgets.find("packed") is Gadget


@pytest.mark.slow
def test_one_that_was_repaired_loads_and_its_problem_is_forgotten(
    gadgets: Plugins[Gadget], install: Callable[[str, str], None], tmp_path: Path
) -> None:
    install("repaired_package", "gadget = repaired_package.part:Gadget")
    with pytest.raises(FishdError):
        gadgets.find("gadget")
    assert "does not load" in gadgets.problems["gadget"]
    sys.modules.pop("repaired_package", None)
    (tmp_path / "repaired_package.py").unlink()
    (tmp_path / "repaired_package").mkdir()
    (tmp_path / "repaired_package" / "__init__.py").touch()
    (tmp_path / "repaired_package" / "part.py").write_text(f"from {__name__} import Gadget\n")
    assert gadgets.find("gadget") is Gadget
    assert not gadgets.problems
