"""What a program says in a terminal as it ends."""

import errno

import click
import pytest

from fishd.core import console
from fishd.core.errors import NoDaemon, ServoError


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


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "track.csv"), "track.csv: No space"),
        (MemoryError(), "there is not enough memory"),
        (OSError(errno.ENOENT, "No such file or directory"), "the working folder was deleted; "),
        (OSError(errno.EMFILE, "Too many open files"), "Too many open files"),
    ],
)
def test_a_file_or_memory_that_makes_trouble_is_one_line(
    error: Exception,
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    @click.command()
    def computes() -> None:
        raise error

    monkeypatch.setattr("sys.argv", ["fishctl"])
    with pytest.raises(SystemExit) as ended:
        console.run(computes, "fishctl")
    assert ended.value.code == 1
    line = capsys.readouterr().err
    assert line.startswith(f"fishctl: {said}")
    assert line.count("\n") == 1


@pytest.mark.parametrize("error", [ServoError("no pulses"), NoDaemon("no fishd")])
def test_an_error_of_fishd_is_no_error_of_the_output(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    @click.command()
    def fails() -> None:
        raise error

    monkeypatch.setattr("sys.argv", ["fishctl"])
    with pytest.raises(type(error), match=str(error)):
        console.run(fails, "fishctl")
