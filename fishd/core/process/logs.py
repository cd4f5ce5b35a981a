"""Structured logs on standard error, written by a separate thread.

A stopped terminal or an unread pipe blocks its writer, which must not be the tick.
"""

import logging
import logging.handlers
import os
import queue
import sys
import threading
import time
from contextlib import suppress

import msgspec

from fishd.core import text

log = logging.getLogger(__name__)

_JOURNAL_LEVELS = {"DEBUG": 7, "INFO": 6, "WARNING": 4, "ERROR": 3, "CRITICAL": 2}
_MAX_QUEUED_LINES = 1000
"""Maximum number of lines kept while standard error blocks; later ones are dropped."""
_FLUSH_TIMEOUT_S = 0.3
"""Maximum time to write the last lines [s]."""
UNHURRIED_FLUSH_TIMEOUT_S = 2.0
"""Maximum time to write the last lines if no servo is driven: long enough for a busy machine
[s]."""
LINE_PERIOD_S = 1.0
"""Shortest time between two lines of a kind where they are limited [s]."""
_MAX_MESSAGE_CHARACTERS = 2000
_MAX_TRACEBACK_CHARACTERS = 10_000
"""Maximum length of a traceback; longer ones are cut [characters]."""


def _format_safely(formatter: logging.Formatter, record: logging.LogRecord) -> tuple[str, str]:
    """Return the message in one line, and the traceback if there is one, both printable."""
    trace = formatter.formatException(record.exc_info) if record.exc_info else ""
    return text.line(record.getMessage(), _MAX_MESSAGE_CHARACTERS), text.block(
        trace, _MAX_TRACEBACK_CHARACTERS
    )


class TextFormatter(logging.Formatter):
    """Formatter of `12:00:00.123 warning fishd.daemon.main: text`; for journald, a level prefix."""

    def __init__(self, journal: bool) -> None:
        super().__init__()
        self._journal = journal

    def format(self, record: logging.LogRecord) -> str:
        """Return one line, and the traceback if there is one."""
        message, trace = _format_safely(self, record)
        if self._journal:  # journald adds the time itself
            head = f"<{_JOURNAL_LEVELS.get(record.levelname, 6)}>"
        else:
            clock = time.strftime("%H:%M:%S", time.localtime(record.created))
            head = f"{clock}.{int(record.msecs):03d} {record.levelname.lower()} "
        return "\n".join(filter(None, (f"{head}{record.name}: {message}", trace)))


class JsonFormatter(logging.Formatter):
    """Formatter of one JSON object per line: t, level, logger, message, and traceback if any."""

    def format(self, record: logging.LogRecord) -> str:
        """Return one line."""
        message, trace = _format_safely(self, record)
        fields = {
            "t": record.created,
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": message,
        }
        if trace:
            fields["traceback"] = trace
        return msgspec.json.encode(fields).decode()


class _Queued(logging.handlers.QueueHandler):
    def handle(self, record: logging.LogRecord) -> bool:
        """Add the record without a lock: a thread that hangs here must not block others."""
        self.emit(record)
        return True

    def enqueue(self, record: logging.LogRecord) -> None:
        """Add the record to the queue; drop it if the queue is full."""
        with suppress(queue.Full):
            self.queue.put_nowait(record)

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        """Format only the message; the writing thread formats the rest, tracebacks included."""
        record.msg, record.args = record.getMessage()[: 2 * _MAX_MESSAGE_CHARACTERS], None
        return record

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  (logging's name)
        """Ignore the error: standard error, where it would be printed, may block."""


class LineLimit(logging.Filter):
    """Limit of one line a second of each kind, which a place in the code writes."""

    def __init__(self) -> None:
        super().__init__()
        self._places: dict[tuple[str, int], tuple[float, int]] = {}
        """By place: when it may write again [s, monotonic], and the lines left out since."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a line is written; it says how many like it were left out before."""
        place, now = (record.pathname, record.lineno), time.monotonic()
        due, left_out = self._places.get(place, (now, 0))
        if now < due:
            self._places[place] = due, left_out + 1
            return False
        self._places[place] = now + LINE_PERIOD_S, 0
        if left_out:
            record.msg = f"{record.getMessage()} ({left_out} more like this before)"
            record.args = None
        return True


class LogWriter:
    """Writer of all logs to standard error, and of the logger `console` to standard output.

    Warnings and uncaught errors of Python are logged, too.
    """

    def __init__(self, style: str) -> None:
        """style: `text` or `json`"""
        self._lines: queue.Queue[logging.LogRecord | None] = queue.Queue(_MAX_QUEUED_LINES)
        self._errors = logging.StreamHandler(sys.stderr)
        journal = bool(os.environ.get("JOURNAL_STREAM")) and not sys.stderr.isatty()
        self._errors.setFormatter(JsonFormatter() if style == "json" else TextFormatter(journal))
        self._console = logging.StreamHandler(sys.stdout)
        root = logging.getLogger()
        root.handlers = [_Queued(self._lines)]
        root.setLevel(logging.INFO)
        logging.captureWarnings(True)
        sys.unraisablehook = _log_unraisable
        threading.excepthook = _log_thread
        self._thread = threading.Thread(target=self._write, name="logs", daemon=True)
        self._thread.start()

    def close(self, timeout: float = _FLUSH_TIMEOUT_S) -> None:
        """Write the remaining lines, within `timeout` [s]; may be called twice."""
        deadline = time.monotonic() + timeout
        with suppress(queue.Full):
            self._lines.put(None, timeout=timeout)
        self._thread.join(max(0.0, deadline - time.monotonic()))

    def _write(self) -> None:
        for record in iter(self._lines.get, None):
            (self._console if record.name == "console" else self._errors).handle(record)


def _log_unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    """Log an exception that cannot be caught, such as one of a __del__."""
    error = unraisable.exc_value
    if error is not None:
        log.error("ignored: %s", text.describe_error(error), exc_info=error)


def _log_thread(hook: threading.ExceptHookArgs) -> None:
    """Log an exception that ended a thread, such as one that a controller started."""
    error = hook.exc_value
    if error is not None and not isinstance(error, SystemExit):
        name = text.quoted(hook.thread.name) if hook.thread else "?"
        log.error("thread %s failed: %s", name, text.describe_error(error), exc_info=error)
