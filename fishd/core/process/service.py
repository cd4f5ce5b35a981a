"""Frame of a server that drives no servo: its log, its end by a signal, and its exit status."""

import logging
import threading
from collections.abc import Callable

from fishd.core.errors import FishdError
from fishd.core.process.interruption import on_signal
from fishd.core.process.logs import UNHURRIED_FLUSH_TIMEOUT_S, LineLimit, LogWriter

log = logging.getLogger(__name__)


def run_service(name: str, log_format: str, serve: Callable[[threading.Event], object]) -> int:
    """Run a server until it returns; log why it failed, and return the exit status.

    serve: returns soon after SIGINT, SIGTERM or SIGHUP has set its event
    """
    logs = LogWriter(log_format)
    logging.getLogger().handlers[0].addFilter(LineLimit())
    stopping = threading.Event()
    try:
        with on_signal(stopping.set):
            serve(stopping)
    except FishdError as error:
        log.critical("%s", error)
        return 1
    except Exception:
        log.critical("%s failed", name, exc_info=True)
        return 1
    finally:
        logs.close(UNHURRIED_FLUSH_TIMEOUT_S)
    return 0
