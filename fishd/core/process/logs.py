"""Structured logs on standard error, written by a thread of their own.

A stopped terminal or a pipe that nobody reads blocks its writer, which must not be the tick.
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
_QUEUE = 1000
"""Lines kept while standard error is stuck; later ones are dropped."""
_CLOSING = 0.3
"""How long the last lines may take to be written [s]."""
UNHURRIED = 2.0
"""The same where nothing is driven; on a busy machine the thread that writes may come late [s]."""
_LONGEST_MESSAGE = 2000
_LONGEST_TRACEBACK = 10_000
"""Longer ones are cut [characters]."""


def _safe(formatter: logging.Formatter, record: logging.LogRecord) -> tuple[str, str]:
    """The message in one line, and the traceback where there is one, both safe to read."""
    trace = formatter.formatException(record.exc_info) if record.exc_info else ""
    return text.line(record.getMessage(), _LONGEST_MESSAGE), text.block(trace, _LONGEST_TRACEBACK)


class TextFormatter(logging.Formatter):
    """`12:00:00.123 warning fishd.daemon.main: text`, with journald's prefix in a journal."""

    def __init__(self, journal: bool) -> None:
        super().__init__()
        self._journal = journal

    def format(self, record: logging.LogRecord) -> str:
        """One line, and the traceback where there is one."""
        message, trace = _safe(self, record)
        if self._journal:  # journald stamps the time itself
            head = f"<{_JOURNAL_LEVELS.get(record.levelname, 6)}>"
        else:
            clock = time.strftime("%H:%M:%S", time.localtime(record.created))
            head = f"{clock}.{int(record.msecs):03d} {record.levelname.lower()} "
        return "\n".join(filter(None, (f"{head}{record.name}: {message}", trace)))


class JsonFormatter(logging.Formatter):
    """One JSON object a line: t, level, logger, message, and traceback where there is one."""

    def format(self, record: logging.LogRecord) -> str:
        """One line."""
        message, trace = _safe(self, record)
        fields = {
            "t": record.created,
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": message,
        }
        if trace:
            fields["traceback"] = trace
        return msgspec.json.encode(fields).decode()


class _NoLock:
    """In place of a lock that a controller may never release: this one cannot be held."""

    def acquire(self) -> bool:
        """Succeeds."""
        return True

    def release(self) -> None:
        """Does nothing."""

    __enter__ = acquire

    def __exit__(self, *_: object) -> None:
        """Does nothing."""


class _Queued(logging.handlers.QueueHandler):
    def createLock(self) -> None:  # noqa: N802  (logging's name)
        """A queue needs no lock: a thread that hangs while it formats must not block the others."""
        self.lock = _NoLock()  # type: ignore[assignment]

    def enqueue(self, record: logging.LogRecord) -> None:
        """Drop the line rather than wait."""
        with suppress(queue.Full):
            self.queue.put_nowait(record)

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        """Leave the formatting, tracebacks included, to the writing thread."""
        record.msg, record.args = record.getMessage()[: 2 * _LONGEST_MESSAGE], None
        return record

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802  (logging's name)
        """Ignore it: standard error, where it would be printed, may be stuck."""


class LogWriter:
    """Sends all logs to standard error; lines for `console` go to standard output as they are.

    Python's own warnings and errors go the same way.
    """

    def __init__(self, style: str) -> None:
        """style: text or json."""
        self._lines: queue.Queue[logging.LogRecord | None] = queue.Queue(_QUEUE)
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

    def close(self, patience: float = _CLOSING) -> None:
        """Write what is left, within `patience` [s]; may be called twice."""
        until = time.monotonic() + patience
        with suppress(queue.Full):
            self._lines.put(None, timeout=patience)
        self._thread.join(max(0.0, until - time.monotonic()))

    def _write(self) -> None:
        for record in iter(self._lines.get, None):
            (self._console if record.name == "console" else self._errors).handle(record)


def _log_unraisable(unraisable: "sys.UnraisableHookArgs") -> None:
    """An exception that nobody can catch, such as one of a __del__."""
    error = unraisable.exc_value
    if error is not None:
        log.error("ignored: %s", text.named(error), exc_info=error)


def _log_thread(hook: threading.ExceptHookArgs) -> None:
    """An exception that ended a thread, such as one that a controller has begun."""
    error = hook.exc_value
    if error is not None and not isinstance(error, SystemExit):
        name = text.quoted(hook.thread.name) if hook.thread else "?"
        log.error("thread %s failed: %s", name, text.named(error), exc_info=error)
