"""Logs: all lines are safe to read, and a reader that has ended delays no program."""

import io
import logging
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
from rigs.processes import PATIENCE

from fishd.core.process.logs import JsonFormatter, LineLimit, LogWriter, TextFormatter


def record(message: str, error: BaseException | None = None) -> logging.LogRecord:
    info = (type(error), error, error.__traceback__) if error else None
    return logging.LogRecord("zoo", logging.ERROR, "", 0, message, None, info)


def raised(error: BaseException) -> BaseException:
    try:
        raise error
    except BaseException as caught:
        return caught


@pytest.mark.parametrize("formatter", [TextFormatter(False), TextFormatter(True), JsonFormatter()])
def test_a_text_of_5_mb_is_cut_and_its_traceback_too(formatter: logging.Formatter) -> None:
    line = formatter.format(record("x" * 5_000_000, raised(RuntimeError("y" * 5_000_000))))
    assert len(line) < 15_000
    assert "Traceback" in line
    assert "in raised" in line


@pytest.mark.parametrize("formatter", [TextFormatter(False), TextFormatter(True), JsonFormatter()])
def test_what_is_logged_is_encoded_and_no_terminal_code(formatter: logging.Formatter) -> None:
    odd = "\x1b[2J\udcff\x9b31m\r\nforged"
    line = formatter.format(record(odd, raised(RuntimeError(odd))))
    line.encode()
    assert all(part.isprintable() for part in line.split("\n"))


def test_a_json_line_is_one_line_of_json() -> None:
    line = JsonFormatter().format(record("two\nlines", raised(RuntimeError("\udcff"))))
    entry = msgspec.json.decode(line)
    assert entry["message"] == "two lines"
    assert entry["traceback"].endswith("RuntimeError: ?")


@contextmanager
def writer(
    monkeypatch: pytest.MonkeyPatch, stderr: io.TextIOBase, timeout: float = PATIENCE
) -> Iterator[LogWriter]:
    """Return a log writer; restore the state of logging afterwards."""
    root = logging.getLogger()
    monkeypatch.setattr(sys, "stderr", stderr)
    monkeypatch.setattr(sys, "unraisablehook", sys.unraisablehook)
    monkeypatch.setattr("threading.excepthook", sys.excepthook)
    handlers, level = root.handlers, root.level
    logs = LogWriter("text")
    try:
        yield logs
    finally:
        logs.close(timeout)
        logging.captureWarnings(False)
        root.handlers = handlers
        root.setLevel(level)


def test_what_was_logged_is_written_before_it_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    output = io.StringIO()
    with writer(monkeypatch, output):
        for number in range(200):
            logging.error("line %d", number)
    assert output.getvalue().count("error root: line ") == 200


class Stuck(io.StringIO):
    """Standard error without a reader."""

    def __init__(self) -> None:
        super().__init__()
        self.let_go = threading.Event()

    def write(self, text: str) -> int:
        self.let_go.wait(10.0)
        return len(text)


@pytest.mark.realtime
def test_it_closes_soon_where_nobody_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    stuck = Stuck()
    with writer(monkeypatch, stuck, timeout=0.3) as logs:
        started = time.monotonic()
        for _ in range(2000):
            logging.error("a line")
        logs.close()
        assert time.monotonic() - started < 1.5
        stuck.let_go.set()


class Unprintable:
    def __str__(self) -> str:
        raise RuntimeError("no text")


def test_what_cannot_be_logged_is_no_trouble(monkeypatch: pytest.MonkeyPatch) -> None:
    output = io.StringIO()
    with writer(monkeypatch, output):
        logging.error("%s", Unprintable())
        logging.error("%d apples", "three")
        logging.error("on")
    assert output.getvalue().endswith("error root: on\n")
    assert output.getvalue().count("\n") == 1


PROGRAM_WITH_SLOW_STDERR = """
import io, os, sys, time

class Late(io.StringIO):
    def write(self, text):
        time.sleep(0.8)
        return os.write(2, text.encode())

sys.stderr = Late()
from {module} import main
sys.argv = sys.argv[1:]
main()
"""
"""Program whose standard error is slow, as on a busy machine."""


@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        ("fishd.daemon.main", ("fishd", "--set", "control.address=ipc://{}/no/control")),
        ("fishd.camera.main", ("fishd-camera", "--set", "publish.requests=ipc://{}/no/requests")),
    ],
)
def test_what_cannot_start_says_why_however_late_its_line_is_written(
    tmp_path: Path, module: str, arguments: tuple[str, ...]
) -> None:
    words = [word.format(tmp_path) for word in arguments]
    command = [sys.executable, "-c", PROGRAM_WITH_SLOW_STDERR.format(module=module), *words]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE)
    assert ended.returncode == 1
    assert f"{tmp_path}/no" in ended.stderr
    assert ended.stderr.endswith("\n")


def test_a_service_writes_one_line_of_a_kind_in_a_second_and_counts_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    limit, now, written = LineLimit(), 0.0, list[str]()
    monkeypatch.setattr(time, "monotonic", lambda: now)

    def write(place: int, text: str) -> None:
        line = logging.LogRecord("fishd", logging.INFO, "file.py", place, "%s", (text,), None)
        if limit.filter(line):
            written.append(line.getMessage())

    for count in range(30):
        write(1, f"100 % {count}")
    write(2, "other")
    now = 1.0
    write(1, "later")
    assert written == ["100 % 0", "other", "later (29 more like this before)"]
