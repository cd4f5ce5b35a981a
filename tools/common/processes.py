"""Programs that run beside tools and tests: start, wait and end."""

import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

BIN = Path(sys.executable).parent
FISHD = str(BIN / "fishd")
FISHCTL = str(BIN / "fishctl")
PATIENCE = 180.0
"""Timeout of the waits of tests and tools [s]."""


def call(*command: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """Run a command to its end; options: those of `subprocess.run`."""
    usual = {"capture_output": True, "text": True, "check": False, "timeout": PATIENCE}
    return subprocess.run(command, **(usual | options))


def sets(*pairs: str) -> list[str]:
    """Return the words of a command line that override these keys of the configuration."""
    return [word for pair in pairs for word in ("--set", pair)]


def wait_until(true: Callable[[], bool]) -> None:
    """Wait until a condition is true; slow checks are repeated less often.

    Frequent checks would slow down the awaited process. Raises AssertionError after `PATIENCE`.
    """
    looked = time.monotonic()
    deadline = looked + PATIENCE
    while not true():
        now = time.monotonic()
        assert now < deadline
        time.sleep(max(0.02, 4.0 * (now - looked)))
        looked = time.monotonic()


class Process:
    """Program that runs beside this one; as a context manager it has ended afterwards."""

    start = staticmethod(subprocess.Popen)

    def __init__(self, *command: str, **options: Any) -> None:
        """options: those of `subprocess.Popen`"""
        usual = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        self.process: subprocess.Popen[str] = self.start(command, **(usual | options))

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self.process.pid

    @property
    def runs(self) -> bool:
        """Whether the process has not ended yet."""
        return self.process.poll() is None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with self.process:
            self.process.kill()

    def finish(self, patience: float = PATIENCE) -> tuple[int, str, str]:
        """Wait until the process ends by itself; return exit status, output and errors."""
        out, err = self.process.communicate(timeout=patience)
        return self.process.returncode, out, err

    def end(self, number: int = signal.SIGTERM) -> tuple[int, str, str]:
        """Send a signal if the process still runs; return exit status, output and errors."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.finish()

    def end_or_kill(self, patience: float) -> None:
        """End the process, also if it is stopped; kill it after a timeout [s]."""
        self.process.send_signal(signal.SIGCONT)
        self.process.terminate()
        try:
            self.process.wait(patience)
        except subprocess.TimeoutExpired:
            self.kill()

    def kill(self) -> None:
        """Kill the process and wait for its end."""
        self.process.kill()
        self.process.wait(PATIENCE)
