"""Files of keys: each wrong one is refused in a line that says what would be right."""

import os
import re
from pathlib import Path

import pytest

from fishd.core import keys
from fishd.core.errors import ConfigError, NoKey

PUBLIC, SECRET = "p" * 40, "s" * 40


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "keys"
    keys.make_keys(folder, PUBLIC, SECRET)
    monkeypatch.setenv("FISHD_KEYS", str(folder))
    return folder


def know(folder: Path, *lines: str) -> None:
    (folder / keys.KNOWN_FILE).write_text("".join(f"{line}\n" for line in lines))


def test_a_new_key_is_for_this_user_alone(folder: Path) -> None:
    modes = {path.name: path.stat().st_mode & 0o777 for path in folder.iterdir()}
    assert (folder.stat().st_mode & 0o777, modes.pop("key.pub") | 0o044) == (0o700, 0o644)
    assert modes == {"key": 0o600, "known": 0o600}
    assert keys.read_secret(folder) == SECRET
    assert keys.read_known(folder) == ([], [])


def test_a_key_is_never_overwritten(folder: Path) -> None:
    with pytest.raises(ConfigError, match="keys/key: it exists, and is not overwritten"):
        keys.make_keys(folder, PUBLIC, "t" * 40)
    assert keys.read_secret(folder) == SECRET


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: path.unlink(), "there is no such file; 'fishctl keygen --to .*' makes a key"),
        (lambda path: path.chmod(0o644), r"other users may read it \(mode 644\); run 'chmod 600 "),
        (lambda path: path.write_text("short"), "does not hold a key of 40 characters"),
        (lambda path: path.write_text(SECRET * 9999), "is longer than 64 kB"),
        (lambda path: path.write_bytes(b"\xff"), "not a text file in UTF-8"),
        (lambda path: (path.unlink(), path.mkdir()), "is a folder; a regular file is needed"),
    ],
    ids=["missing", "open", "short", "long", "binary", "folder"],
)
def test_a_wrong_secret_key_is_refused(folder: Path, change: object, message: str) -> None:
    assert callable(change)
    change(folder / keys.SECRET_FILE)
    with pytest.raises(ConfigError, match=f"keys/key: .*{message}") as refusal:
        keys.read_secret(folder)
    assert "\n" not in str(refusal.value)


def test_the_key_of_another_user_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    owner = (folder / keys.SECRET_FILE).stat().st_uid
    os.chown(folder / keys.SECRET_FILE, 65534, -1) if not os.getuid() else None
    monkeypatch.setattr("fishd.core.keys.os.getuid", lambda: owner + 1)
    with pytest.raises(ConfigError, match="belongs to another user"):
        keys.read_secret(folder)


@pytest.mark.parametrize("line", ["drive", f"swim {PUBLIC} anna", "watch kurz", f"{PUBLIC} drive"])
def test_a_malformed_line_is_named_and_the_others_count(folder: Path, line: str) -> None:
    know(folder, "# keys", "", f"drive {PUBLIC} anna of the lab", line, f"tcp://fish:1 {PUBLIC}")
    known, mistakes = keys.read_known(folder)
    assert known == [("drive", PUBLIC, "anna of the lab"), ("tcp://fish:1", PUBLIC, "")]
    assert [re.search(r"known, line (\d)", mistake)[1] for mistake in mistakes] == ["4"]  # type: ignore[index]


def test_a_list_that_others_may_change_is_refused(folder: Path) -> None:
    (folder / keys.KNOWN_FILE).chmod(0o666)
    with pytest.raises(ConfigError, match=r"users may change it \(mode 666\); run 'chmod 644"):
        keys.read_known(folder)


def test_a_client_uses_its_key_only_where_it_knows_the_fishd(folder: Path) -> None:
    know(folder, f"tcp://fish:9877 {PUBLIC}")
    assert keys.find_access("tcp://fish:9877") == (folder, SECRET, PUBLIC)
    assert keys.find_access("tcp://fish:9876") is None
    (folder / keys.KNOWN_FILE).unlink()
    with pytest.raises(NoKey, match="known: there is no such file"):
        keys.find_access("tcp://fish:9877")
    know(folder, "tcp://fish:9877 short")
    with pytest.raises(NoKey, match="known, line 1: "):
        keys.find_access("tcp://fish:9877")


def test_a_client_without_keys_connects_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FISHD_KEYS", raising=False)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    assert keys.find_access("tcp://fish:9877") is None
    keys.make_keys(keys.client_folder(), PUBLIC, SECRET)
    assert (tmp_path / "fishd" / "keys" / "key").exists()
