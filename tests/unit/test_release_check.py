"""`make release-check`: each check runs, also after one that failed, and the table says so."""

import re
import sys
from pathlib import Path

import pytest

import release_check


@pytest.mark.slow
def test_a_failed_check_stops_no_other_and_a_refused_one_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    commands = {"first": ["sh", "-c", "echo broken; exit 3"], "second": ["true"]}
    commands["third"] = ["sh", "-c", "echo 'trial: not run here: no root' >&2; exit 1"]
    monkeypatch.setattr(release_check, "ROOT", tmp_path)
    monkeypatch.setattr(release_check, "LOGS", tmp_path / "logs")
    monkeypatch.setattr(release_check, "CHECKS", commands)
    monkeypatch.setattr(sys, "argv", ["release_check", "--only", *commands])
    with pytest.raises(SystemExit) as ended:
        release_check.main()
    assert ended.value.code
    *_, failed, passed, refused = capsys.readouterr().out.splitlines()
    failure = r"\| first \| \d+ \| FAILED with exit status 3: logs/first.log \|"
    assert re.fullmatch(failure, failed)
    assert re.fullmatch(r"\| second \| \d+ \| passed \|", passed)
    assert re.fullmatch(r"\| third \| \d+ \| not run here: no root \|", refused)
    assert (tmp_path / "logs" / "first.log").read_text() == "broken\n"


def test_every_check_that_make_runs_is_a_target() -> None:
    makefile = (release_check.ROOT / "Makefile").read_text(encoding="utf-8")
    for command in release_check.CHECKS.values():
        assert command[0] != "make" or f"\n{command[1]}: " in makefile
