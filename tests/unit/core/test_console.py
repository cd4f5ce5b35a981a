"""The messages of a program in a terminal at its end."""

import errno
from collections.abc import Callable

import click
import pytest

from fishd.core import console
from fishd.core.errors import NoDaemon

Run = Callable[[BaseException], tuple[object, str]]


@pytest.fixture
def end(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Run:
    """Run a command that raises an error; its exit status and what it says."""

    def run(error: BaseException) -> tuple[object, str]:
        @click.command()
        def computes() -> None:
            raise error

        monkeypatch.setattr("sys.argv", ["fishctl"])
        with pytest.raises(SystemExit) as ended:
            console.run(computes, "fishctl")
        return ended.value.code, capsys.readouterr().err.strip()

    return run


@pytest.mark.parametrize("error", [KeyboardInterrupt(), EOFError()])
def test_a_command_that_is_interrupted_says_so(end: Run, error: BaseException) -> None:
    assert end(error) == (console.INTERRUPTED, "fishctl: interrupted")


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(errno.ENOSPC, "No space left on device", "track.csv"), "track.csv: No space"),
        (MemoryError(), "not enough memory"),
        (OSError(errno.ENOENT, "No such file or directory"), "the working folder was deleted; "),
        (OSError(errno.EMFILE, "Too many open files"), "Too many open files"),
    ],
)
def test_trouble_with_a_file_or_memory_is_one_line(end: Run, error: Exception, words: str) -> None:
    status, line = end(error)
    assert (status, "\n" in line) == (1, False)
    assert line.startswith(f"fishctl: {words}")


def test_an_error_of_fishd_is_no_error_of_the_output(end: Run) -> None:
    with pytest.raises(NoDaemon, match="no fishd"):
        end(NoDaemon("no fishd"))
