"""A folder with keys: other users may neither change nor replace it."""

import os
import re
from pathlib import Path

import pytest

from fishd.core.trusted_folder import find_folder_problem

MODES_OF_OTHERS = (0o720, 0o702, 0o777, 0o1777)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder `shared/keys` that this user alone may change."""
    folder = tmp_path / "shared" / "keys"
    folder.mkdir(mode=0o700, parents=True)
    folder.parent.chmod(0o755)
    return folder


@pytest.mark.parametrize("mode", MODES_OF_OTHERS, ids=oct)
def test_a_folder_that_others_may_write_is_named_with_its_remedy(folder: Path, mode: int) -> None:
    assert find_folder_problem(folder) is None
    folder.chmod(mode)
    remedy = f"{folder}: other users may change it (mode {mode:o}); run 'chmod go-w {folder}'"
    assert find_folder_problem(folder) == remedy
    folder.chmod(mode & ~0o022)
    assert find_folder_problem(folder) is None


def test_a_folder_on_the_way_lets_others_replace_it_unless_it_is_sticky(folder: Path) -> None:
    folder.parent.chmod(0o777)
    problem = find_folder_problem(folder)
    assert f"and so replace {folder} (mode 777); run 'chmod go-w {folder.parent}'" in problem
    folder.parent.chmod(0o1777)
    assert find_folder_problem(folder) is None


def test_a_link_is_followed_and_whatever_others_may_replace_on_its_way_is_named(
    folder: Path, tmp_path: Path
) -> None:
    for way in (tmp_path / "absolute", tmp_path / "shared" / ".." / "relative"):
        way.symlink_to(folder if way.name == "absolute" else "shared/keys")
        assert find_folder_problem(way) is None
    folder.parent.chmod(0o777)
    for way in (tmp_path / "absolute", tmp_path / "relative"):
        assert f"run 'chmod go-w {folder.parent}'" in find_folder_problem(way)
    folder.parent.chmod(0o755)
    folder.chmod(0o777)
    assert f"run 'chmod go-w {folder}'" in find_folder_problem(tmp_path / "absolute")


def test_a_loop_of_links_and_a_missing_folder_end_the_search(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to("loop")
    assert find_folder_problem(tmp_path / "loop" / "keys") is None
    assert find_folder_problem(tmp_path / "missing" / "keys") is None


@pytest.mark.skipif(os.geteuid() != 0, reason="only root gives a folder to another user")
@pytest.mark.parametrize("which", ["folder", "parent", "link"])
def test_what_belongs_to_another_user_is_named_unless_that_user_is_trusted(
    folder: Path, tmp_path: Path, which: str
) -> None:
    link = tmp_path / "link"
    link.symlink_to(folder)
    other = {"folder": folder, "parent": folder.parent, "link": link}[which]
    os.chown(other, 4711, -1, follow_symlinks=False)
    owned = rf"{other} belongs to another user \(id 4711\); .* run 'sudo chown -h 0 {other}'"
    assert re.fullmatch(owned, find_folder_problem(link))
    assert find_folder_problem(link, 4711) is None
