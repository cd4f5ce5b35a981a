"""Commands of fishd in this process, which saves their start-up time."""

import contextlib
import io
import signal
import subprocess
import sys

from fishd.cli.main import main
from fishd.core.process.interruption import SIGNALS


def fishctl(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run fishctl, and return its output and its exit status.

    Not suitable for trials with signals or terminals.
    """
    out, err = io.StringIO(), io.StringIO()
    argv, sys.argv = sys.argv, ["fishctl", *arguments]
    handlers = {number: signal.getsignal(number) for number in SIGNALS}
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main()
    except SystemExit as ended:
        status = ended.code
    finally:
        sys.argv = argv
        for number, handler in handlers.items():  # `watch` and `record` change some
            signal.signal(number, handler)
    assert isinstance(status, int)
    return subprocess.CompletedProcess(arguments, status, out.getvalue(), err.getvalue())
