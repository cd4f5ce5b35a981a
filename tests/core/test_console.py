"""What a program says in a terminal as it ends."""

import errno

import click
import pytest
from rigs.processes import fishctl, one_line

from fishd.cli import main
from fishd.core import console


@pytest.mark.parametrize("how", [KeyboardInterrupt, EOFError])
def test_a_command_that_is_interrupted_says_so(
    how: type[BaseException],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    @click.command()
    def computes() -> None:
        raise how

    monkeypatch.setattr("sys.argv", ["fishctl"])
    with pytest.raises(SystemExit) as ended:
        console.run(computes, "fishctl")
    assert ended.value.code == console.INTERRUPTED
    assert capsys.readouterr().err.strip() == "fishctl: interrupted"


def test_a_file_that_makes_trouble_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device", "track.csv")

    monkeypatch.setattr(main, "run", fail)
    assert one_line(fishctl("status")) == "fishctl: track.csv: No space left on device\n"
