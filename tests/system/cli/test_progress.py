"""The bar of an experiment is for a person: the output is clean for a program."""

import os
import pty
import subprocess
import sys

import pytest

SHOWS = """
from fishd.cli.progress import show_progress
from fishd.cli.output import print_json
with show_progress(2.0, "s", err={err}) as show:
    show.done("one is done", 1.0)
    show.at(2.0)
print_json([1])
"""


def shown_on_a_terminal(err: bool) -> tuple[str, str]:
    """What goes into a pipe, and what a terminal shows that is standard error only."""
    ours, theirs = pty.openpty()
    command = [sys.executable, "-c", SHOWS.format(err=err)]
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=theirs, text=True, check=True)
    os.close(theirs)
    seen = b""
    try:
        while chunk := os.read(ours, 4096):
            seen += chunk
    except OSError:  # nobody writes there any more
        pass
    os.close(ours)
    return done.stdout, seen.decode()


@pytest.mark.parametrize("err", [True, False])
def test_the_bar_is_on_standard_error_and_lines_where_they_are_wanted(err: bool) -> None:
    out, seen = shown_on_a_terminal(err)
    assert "2 of 2 s" in seen
    assert ("one is done" in seen) == err
    assert out == ("" if err else "one is done\n") + "[\n  1\n]\n"
