"""Structured logs on standard error, written by a thread of their own.

A terminal that is stopped or a pipe that nobody reads blocks its writer; it must not block a tick.
"""

import logging
import logging.handlers
import os
import queue
import sys
import time

import msgspec

_JOURNAL_LEVELS = {"DEBUG": 7, "INFO": 6, "WARNING": 4, "ERROR": 3, "CRITICAL": 2}
_QUEUE = 1000
"""Lines kept while standard error is stuck; later ones are dropped."""


class TextFormatter(logging.Formatter):
    """`12:00:00.123 warning fishd.loop: message`, or with journald's level prefix for a journal."""

    def __init__(self, journal: bool) -> None:
        super().__init__()
        self._journal = journal

    def format(self, record: logging.LogRecord) -> str:
        """One line, and the traceback where there is one."""
        text = f"{record.levelname.lower()} {record.name}: {record.getMessage()}"
        if self._journal:  # journald stamps the time itself
            text = (
                f"<{_JOURNAL_LEVELS.get(record.levelname, 6)}>{record.name}: {record.getMessage()}"
            )
        else:
            clock = time.strftime("%H:%M:%S", time.localtime(record.created))
            text = f"{clock}.{int(record.msecs):03d} {text}"
        if record.exc_info:
            text += "\n" + self.formatException(record.exc_info)
        return text


class JsonFormatter(logging.Formatter):
    """One JSON object a line: t, level, logger, message, and traceback where there is one."""

    def format(self, record: logging.LogRecord) -> str:
        """One line."""
        fields = {
            "t": record.created,
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        if record.exc_info:
            fields["traceback"] = self.formatException(record.exc_info)
        return msgspec.json.encode(fields).decode()


class _Queued(logging.handlers.QueueHandler):
    def enqueue(self, record: logging.LogRecord) -> None:
        """Drop the line rather than wait."""
        try:
            self.queue.put_nowait(record)
        except queue.Full:
            return

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        """Leave the formatting, tracebacks included, to the writing thread."""
        record.msg, record.args = record.getMessage(), None
        return record


class LogWriter:
    """Sends all logs to standard error; lines for `console` go to standard output as they are."""

    def __init__(self, style: str) -> None:
        """style: text or json."""
        lines: queue.Queue[logging.LogRecord] = queue.Queue(_QUEUE)
        errors = logging.StreamHandler(sys.stderr)
        journal = bool(os.environ.get("JOURNAL_STREAM")) and not sys.stderr.isatty()
        errors.setFormatter(JsonFormatter() if style == "json" else TextFormatter(journal))
        errors.addFilter(lambda record: record.name != "console")
        console = logging.StreamHandler(sys.stdout)
        console.addFilter(lambda record: record.name == "console")
        self._listener = logging.handlers.QueueListener(lines, errors, console)
        root = logging.getLogger()
        root.handlers = [_Queued(lines)]
        root.setLevel(logging.INFO)
        self._listener.start()

    def close(self) -> None:
        """Write what is left; may be called twice."""
        if getattr(self._listener, "_thread", None) is not None:
            self._listener.stop()
