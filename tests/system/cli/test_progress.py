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

VALUES = """
from fishd.cli.progress import show_progress
from fishd.core.experiments import Estimate
with show_progress(2.0, "s") as show:
    show.at(1.0)
    show.estimate([Estimate(name, 1.7, 1.6, 1.8, "Hz") for name in ("lowest", "highest")])
"""
WAITING = """
from fishd.cli.progress import show_waiting
with show_waiting("fitting"):
    pass
print("fitted")
"""


def run_on_terminal(program: str) -> tuple[str, str]:
    """Return the output in a pipe, and the standard error on a terminal."""
    reading_end, terminal = pty.openpty()
    command = [sys.executable, "-c", program]
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
    out, shown = run_on_terminal(PROGRAM.format(err=err))
    assert "2 of 2 s" in shown
    assert ("one is done" in shown) == err
    assert out == ("" if err else "one is done\n") + "[\n  1\n]\n"


def test_values_are_whole_below_the_bar() -> None:
    _, shown = run_on_terminal(VALUES)
    lines = shown.splitlines()
    place = lines.index("lowest 1.7 Hz [1.6, 1.8], highest 1.7 Hz [1.6, 1.8]")
    assert "1 of 2 s" in lines[place - 1]
    assert "left" in lines[place - 1]


@pytest.mark.parametrize("columns", [40, 60])
def test_times_are_whole_on_a_narrow_terminal(
    columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    _, shown = run_on_terminal(VALUES.replace("2.0", "180.0"))
    assert "passed, " in shown
    assert "…" not in shown


def test_work_of_unknown_length_is_named_on_a_terminal_only() -> None:
    out, shown = run_on_terminal(WAITING)
    assert out == "fitted\n"
    assert "fitting" in shown
    done = subprocess.run(
        [sys.executable, "-c", WAITING], capture_output=True, text=True, check=True
    )
    assert (done.stdout, done.stderr) == ("fitted\n", "")
