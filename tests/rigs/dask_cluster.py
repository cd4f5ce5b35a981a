"""A Dask scheduler and its workers, as processes on the loopback interface."""

import os
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from common.processes import PATIENCE, wait_until


def wait_for_file(path: Path) -> int:
    """Wait until a file exists, in a worker; return the id of its process."""
    wait_until(path.exists)
    return os.getpid()


class DaskCluster:
    """A scheduler without workers, and what starts workers of one thread each."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "scheduler.json"
        self._folder = folder
        self._processes: list[subprocess.Popen[bytes]] = []
        self.scheduler = self._start("scheduler", "--port", "0")

    @property
    def address(self) -> str:
        """Address of the scheduler, which it writes into its file."""
        from distributed.utils import json_load_robust

        wait_until(self.file.exists)
        address: str = json_load_robust(self.file)["address"]
        return address

    def add_worker(self, environment: Mapping[str, str] | None = None) -> subprocess.Popen[bytes]:
        """Start a worker, and wait until the scheduler knows it."""
        import distributed

        words = ("--nworkers", "1", "--nthreads", "1", "--no-nanny", "--death-timeout", "60")
        worker = self._start("worker", *words, environment=environment)
        with distributed.Client(self.address, timeout=PATIENCE) as client:
            before = sum(process.poll() is None for process in self._processes[1:])
            client.wait_for_workers(before, timeout=PATIENCE)
        return worker

    def close(self) -> None:
        """Kill all processes."""
        for process in reversed(self._processes):
            process.kill()
            process.wait(PATIENCE)

    def _start(
        self, kind: str, *words: str, environment: Mapping[str, str] | None = None
    ) -> subprocess.Popen[bytes]:
        where = ("--scheduler-file", str(self.file), "--host", "127.0.0.1", "--no-dashboard")
        process = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{kind}", *words, *where],
            cwd=self._folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **(environment or {})},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        self._processes.append(process)
        return process


@contextmanager
def dask_cluster(folder: Path) -> Iterator[DaskCluster]:
    """Run a scheduler in a folder while this lasts."""
    cluster = DaskCluster(folder)
    try:
        yield cluster
    finally:
        cluster.close()
