"""tools/locks: the versions and hashes of a robot's packages, written by `make lock`."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from rigs.documents import ROOT, text_of

PROJECT = tomllib.loads(text_of(ROOT / "pyproject.toml"))["project"]
each_lock = pytest.mark.parametrize(
    "lock", sorted((ROOT / "tools" / "locks").iterdir()), ids=lambda path: path.stem
)


def requirements(lines: list[str]) -> Iterator[Requirement]:
    """Return requirements, with those of the extras of fishd that they name."""
    for requirement in map(Requirement, lines):
        if requirement.name == "fishd":
            for extra in requirement.extras:
                yield from requirements(PROJECT["optional-dependencies"][extra])
        else:
            yield requirement


def test_there_is_a_lock_for_each_python_of_debian() -> None:
    names = {path.name for path in (ROOT / "tools" / "locks").iterdir()}
    assert names == {"python3.11.txt", "python3.13.txt"}


@each_lock
def test_every_locked_package_has_hashes_and_no_address(lock: Path) -> None:
    text = text_of(lock)
    assert "://" not in text
    _, *entries = re.split(r"^(?=\w)", text, flags=re.MULTILINE)
    for entry in entries:
        assert re.fullmatch(r"[\w.-]+==\S+ (\\\n    --hash=sha256:[0-9a-f]{64} ?)+\n", entry), entry


@each_lock
def test_the_locked_versions_are_those_that_fishd_permits(lock: Path) -> None:
    versions = dict(re.findall(r"^([\w.-]+)==(\S+)", text_of(lock), re.MULTILINE))
    extras = re.search(r"^LOCKED := (.+)$", text_of(ROOT / "Makefile"), re.MULTILINE)
    assert extras
    own = f"fishd[{','.join(extras[1].split())}]"
    for requirement in requirements([*PROJECT["dependencies"], own]):
        version = versions[canonicalize_name(requirement.name)]
        assert requirement.specifier.contains(version), requirement
