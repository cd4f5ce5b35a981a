"""Debian container in a root folder, with a separate systemd, and its journal."""

import contextlib
import json
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from common.report import BrokenPromise

TIMEOUT_S = 30.0
"""Timeout of every operation [s]."""
_ENVIRONMENT = ("env", "-i", "LANG=C.UTF-8", "PATH=/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin")


class Entry(NamedTuple):
    """Line of the journal."""

    time: float
    """Time on the monotonic clock that the container shares with this machine [s]."""
    unit: str
    message: str


class Container:
    """Container that boots at the start of the context, and is always shut down at its end."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def __enter__(self) -> "Container":
        # No registration and no scope: both would need a systemd on this machine.
        options = ["--register=no", "--keep-unit", "--private-network", "--resolv-conf=off"]
        options += ["--console=read-only", "--capability=CAP_IPC_LOCK"]
        self._console = (self.root.parent / "console.log").open("wb")
        self._nspawn = subprocess.Popen(
            ["systemd-nspawn", "--quiet", *options, f"--directory={self.root}", "--boot"],
            stdin=subprocess.DEVNULL,
            stdout=self._console,
            stderr=subprocess.STDOUT,
        )
        try:
            wait_for(self._has_leader, "the container does not start")
            wait_for(self._has_booted, "the container does not finish to boot")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._nspawn.terminate()  # this shuts down its systemd
        try:
            self._nspawn.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._nspawn.kill()
            self._nspawn.wait()
        self._console.close()

    def run(self, *command: str, check: bool = True) -> str:
        """Run a command inside, and return its output; raises `BrokenPromise` when it fails."""
        done = subprocess.run(
            self.command(*command), capture_output=True, text=True, check=False, timeout=300
        )
        if check and done.returncode:
            raise BrokenPromise(f"{' '.join(command)}: {(done.stderr or done.stdout).strip()}")
        return done.stdout.strip()

    def command(self, *command: str) -> list[str]:
        """Return the command line that runs a command inside."""
        namespaces = ["--mount", "--uts", "--ipc", "--net", "--pid"]
        return ["nsenter", f"--target={self._leader}", *namespaces, *_ENVIRONMENT, *command]

    def show(self, unit: str, name: str) -> str:
        """Return a property of a unit."""
        return self.run("systemctl", "show", "--property", name, "--value", unit)

    def journal(self, since: float) -> list[Entry]:
        """Return the journal of systemd about fishd and of fishd, from a time [s] on."""
        self.run("journalctl", "--sync")
        units = ["--unit=fishd.service", "--unit=fishd-failure.service"]
        lines = self.run("journalctl", "--output=json", "--no-pager", *units).splitlines()
        entries = []
        for fields in map(json.loads, lines):
            at = int(fields["__MONOTONIC_TIMESTAMP"]) * 1e-6
            unit = fields.get("UNIT") or fields.get("_SYSTEMD_UNIT", "")
            if at >= since and isinstance(fields["MESSAGE"], str):
                entries.append(Entry(at, unit, fields["MESSAGE"]))
        return entries

    def _has_leader(self) -> bool:
        if self._nspawn.poll() is not None:
            raise BrokenPromise(f"systemd-nspawn ended; see {self._console.name}")
        children = Path(f"/proc/{self._nspawn.pid}/task/{self._nspawn.pid}/children").read_text()
        for child in children.split():
            # Children that only prepare the container end by themselves.
            with contextlib.suppress(OSError):
                status = Path(f"/proc/{child}/status").read_text()
                if "Name:\tsystemd\n" in status:
                    self._leader = int(child)
                    return True
        return False

    def _has_booted(self) -> bool:
        return self.run("systemctl", "is-system-running", check=False) in ("running", "degraded")


def wait_for(condition: Callable[[], bool], otherwise: str, patience: float = TIMEOUT_S) -> float:
    """Wait for a condition, and return the time [s]; raises `BrokenPromise` with `otherwise`."""
    deadline = time.monotonic() + patience
    while time.monotonic() < deadline:
        if condition():
            return time.monotonic()
        time.sleep(0.02)
    raise BrokenPromise(otherwise)
