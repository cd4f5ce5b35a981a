"""The bar of an experiment goes to standard error: programs can read the output."""

import os
import pty
import subprocess
import sys

import pytest

PROGRAM = """
from fishd.cli.progress import show_progress
from fishd.cli.output import print_json
with show_progress(2.0, "s", err={err}) as show:
    show.done("one is done", 1.0)
    show.at(2.0)
print_json([1])
"""


def run_on_terminal(err: bool) -> tuple[str, str]:
    """Return the output in a pipe, and the standard error on a terminal."""
    reading_end, terminal = pty.openpty()
    command = [sys.executable, "-c", PROGRAM.format(err=err)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=terminal, text=True, check=True)
    os.close(terminal)
    shown = b""
    try:
        while chunk := os.read(reading_end, 4096):
            shown += chunk
    except OSError:  # no process writes there any more
        pass
    os.close(reading_end)
    return done.stdout, shown.decode()


@pytest.mark.parametrize("err", [True, False])
def test_the_bar_is_on_standard_error_and_the_lines_on_either_stream(err: bool) -> None:
    out, shown = run_on_terminal(err)
    assert "2 of 2 s" in shown
    assert ("one is done" in shown) == err
    assert out == ("" if err else "one is done\n") + "[\n  1\n]\n"
