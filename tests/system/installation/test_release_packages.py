"""Packages of a release: their version comes from the tag, and the documents agree with it."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.version import Version
from rigs.documents import ROOT, text_of
from rigs.processes import call

import fishd
import release

pytestmark = pytest.mark.slow
PARTS = ["CHANGELOG.md", "CITATION.cff", "LICENSE", "README.md", "hatch_build.py", "pyproject.toml"]
PARTS += ["config", "fishd", "systemd", "tools/release.py"]


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A copy of what the packages are made of, without the history of git."""
    folder = tmp_path / "checkout"
    (folder / "tools").mkdir(parents=True)
    # Other test processes write bytecode at the same time.
    without = shutil.ignore_patterns("__pycache__")
    for part in PARTS:
        if (ROOT / part).is_dir():
            shutil.copytree(ROOT / part, folder / part, ignore=without)
        else:
            shutil.copy(ROOT / part, folder / part)
    shutil.copy(ROOT / ".gitignore", folder)
    return folder


def git(folder: Path, *words: str) -> None:
    identity = ["-c", "user.name=A", "-c", "user.email=a@localhost"]
    subprocess.run(["git", *identity, *words], cwd=folder, check=True, capture_output=True)


def commit(folder: Path) -> None:
    git(folder, "init", "--quiet")
    git(folder, "add", ".")
    git(folder, "commit", "--quiet", "--message", "All of it")


def build(folder: Path) -> tuple[Path, Path]:
    """Return the sdist and the wheel of a checkout."""
    done = call(sys.executable, "-m", "hatchling", "build", cwd=folder)
    assert done.returncode == 0, done.stderr
    (sdist,), (wheel,) = folder.glob("dist/*.tar.gz"), folder.glob("dist/*.whl")
    return sdist, wheel


def test_the_version_of_the_packages_and_of_the_program_is_that_of_the_tag(checkout: Path) -> None:
    commit(checkout)
    git(checkout, "tag", "v7.8.9")
    sdist, wheel = build(checkout)
    assert (sdist.name, wheel.name) == ("fishd-7.8.9.tar.gz", "fishd-7.8.9-py3-none-any.whl")
    start = "from fishd.__main__ import fishd; fishd()"
    done = call(
        *[sys.executable, "-P", "-c", start, "--version"],
        env=os.environ | {"PYTHONPATH": str(wheel)},
    )
    assert done.stdout == "fishd, version 7.8.9\n"


def test_a_source_without_history_has_the_version_of_its_file(checkout: Path) -> None:
    done = call(sys.executable, "-m", "hatchling", "version", cwd=checkout)
    assert done.stdout.strip() == fishd.__version__, done.stderr


def test_the_sdist_builds_the_same_wheel_as_the_checkout(tmp_path: Path) -> None:
    release.build(tmp_path, None)  # exits where they differ


def test_the_documents_agree_on_the_version() -> None:
    fallback = re.search(r'^fallback-version = "(.+?)"', text_of(ROOT / "pyproject.toml"), re.M)
    assert fallback
    assert fallback[1] == fishd.__version__
    following = Version(fishd.__version__)
    assert following.dev == 0
    released = release.logged_versions()
    if released:
        assert released[0] == release.cited_version()
        assert following > Version(released[0])
    else:
        assert following.base_version == release.cited_version()


def test_a_release_needs_its_section_of_the_changelog_and_committed_files(checkout: Path) -> None:
    commit(checkout)
    (checkout / "CITATION.cff").write_text("version: 7.8.9\n")
    done = call(sys.executable, checkout / "tools" / "release.py", cwd=checkout)
    assert done.returncode == 1
    assert done.stderr.splitlines() == [
        "CHANGELOG.md: the section after [Unreleased] must be '## [7.8.9] - DATE', "
        "for version 7.8.9 of CITATION.cff",
        "uncommitted changes: CITATION.cff",
    ]


def test_a_version_that_another_commit_has_is_not_released_again(checkout: Path) -> None:
    (checkout / "CITATION.cff").write_text("version: 7.8.9\n")
    (checkout / "CHANGELOG.md").write_text("## [Unreleased]\n\n## [7.8.9] - 2026-11-27\n")
    commit(checkout)
    git(checkout, "tag", "v7.8.9")
    git(checkout, "commit", "--quiet", "--allow-empty", "--message", "More")
    done = call(sys.executable, checkout / "tools" / "release.py", cwd=checkout)
    assert done.stderr == ("v7.8.9 is another commit already: raise the version in CITATION.cff\n")
