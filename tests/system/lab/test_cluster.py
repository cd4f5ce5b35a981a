"""Computations on the workers of a Dask cluster: what they find, and what is lost with them."""

import os
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from rigs.dask_cluster import DaskCluster, dask_cluster, wait_for_file
from rigs.processes import FISHCTL, PATIENCE, fishctl, wait_until

from fishd.core.process.interruption import on_signal
from fishd.lab.parallel import workers
from fishd.lab.workers import Unfinished

pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")

from fishd.lab import cluster as connection

SHORT_SWIM = ("--periods", "2", "--settle", "1", "--on", "simulation")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[DaskCluster]:
    """Run a cluster with one worker of one thread."""
    with dask_cluster(tmp_path_factory.mktemp("cluster")) as running:
        running.add_worker()
        yield running


def rows(folder: Path) -> list[str]:
    """Return the rows of a table, without the path of the recording."""
    table = (folder / "rows.csv").read_text().splitlines()
    return [row.rpartition(",")[0] for row in table]


def test_a_worker_of_one_thread_finds_what_this_machine_finds(
    tmp_path: Path, cluster: DaskCluster
) -> None:
    words = ("sweep", "square", "--frequency", "1.5,2", *SHORT_SWIM, "--folder")
    there = fishctl(*words, str(tmp_path / "there"), "--cluster", cluster.address)
    assert (there.returncode, there.stderr) == (0, ""), there.stderr
    assert fishctl(*words, str(tmp_path / "here"), "--jobs", "1").returncode == 0
    assert rows(tmp_path / "here") == rows(tmp_path / "there")
    with workers(tmp_path / "stop", cluster=str(cluster.file)) as crew:
        [(_, worker)] = crew.run(wait_for_file, [tmp_path])
    assert worker != os.getpid()


@contextmanager
def listener(answer: bytes, send: int | None = None) -> Iterator[str]:
    """Listen at an address; give each connection an answer, and this process a signal."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        connections = []

        def serve() -> None:
            while True:
                try:
                    connections.append(server.accept()[0])
                except OSError:
                    return
                connections[-1].sendall(answer)
                if send:
                    os.kill(os.getpid(), send)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
        finally:
            server.shutdown(socket.SHUT_RDWR)
            thread.join()
            for connected in connections:
                connected.close()


@pytest.mark.parametrize(
    ("answer", "cause"),
    [
        (b"", "what listens there is silent, like a dashboard"),
        (b"SSH-2.0-OpenSSH_9.2\r\n", "another program listens there"),
        (None, "cannot connect"),
    ],
)
def test_what_is_not_a_scheduler_is_one_line_with_the_command_to_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: bytes | None, cause: str
) -> None:
    monkeypatch.setattr(connection, "CONNECT_TIMEOUT_S", 0.5)
    folder = str(tmp_path / "run")
    with listener(answer or b"") as address:
        address = "tcp://127.0.0.1:1" if answer is None else address
        words = ("sweep", "square", "--frequency", "1.5", *SHORT_SWIM, "--folder", folder)
        done = fishctl(*words, "--cluster", address)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr
    assert f"no Dask scheduler answers at {address}: {cause}" in done.stderr
    resume = f"resume with: fishctl sweep --resume {folder}; add --cluster ADDRESS to use a cluster"
    assert resume in done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_connection_to_a_silent_program(tmp_path: Path, number: int) -> None:
    with listener(b"", send=number) as address:
        words = ("sweep", "square", *SHORT_SWIM, "--folder", str(tmp_path / "run"))
        done = fishctl(*words, "--cluster", address)
    assert (done.returncode, done.stderr.count("\n")) == (130, 1), done.stderr
    assert "interrupted, 0 of 1 point are kept; resume with: fishctl sweep" in done.stderr


def test_other_versions_are_refused_also_on_a_worker_that_joins_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cluster: DaskCluster
) -> None:
    difference = (
        rf"\d( and 1 more)?: fishd {connection.__version__} \(here 9\.9\); install the same"
    )
    with workers(tmp_path / "stop", cluster=cluster.address) as crew:
        monkeypatch.setattr(connection, "__version__", "9.9")
        with pytest.raises(Unfinished, match=difference) as late:
            list(crew.run(abs, [-1]))
    assert late.value.unfinished == [0]
    with (
        pytest.raises(Unfinished, match=difference),
        workers(tmp_path / "stop", cluster=cluster.address),
    ):
        pass


def test_a_worker_without_fishd_is_named(tmp_path: Path, cluster: DaskCluster) -> None:
    (tmp_path / "fishd").mkdir()
    (tmp_path / "fishd" / "__init__.py").touch()
    worker = cluster.add_worker({"PYTHONPATH": str(tmp_path)})
    try:
        with (
            pytest.raises(
                Unfinished, match=r"\d: fishd cannot be used there: .*No module named 'fi"
            ),
            workers(tmp_path / "stop", cluster=cluster.address),
        ):
            pass
    finally:
        worker.kill()
        worker.wait(PATIENCE)


def test_without_a_worker_a_computation_ends_by_itself_and_by_a_signal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "NO_WORKER_TIMEOUT_S", 0.0)
    with dask_cluster(tmp_path) as alone:
        worker = alone.add_worker()
        with workers(tmp_path / "stop", cluster=alone.address) as crew, on_signal(crew.ask_to_stop):
            running = crew.run(wait_for_file, [tmp_path / "never", tmp_path, tmp_path / "never"])
            worker.kill()
            with pytest.raises(Unfinished, match="no worker is left") as lost:
                list(running)
            assert {0, 2} <= {*lost.value.unfinished}
            monkeypatch.setattr(connection, "NO_WORKER_TIMEOUT_S", 1e6)
            os.kill(os.getpid(), signal.SIGINT)
            assert list(crew.run(wait_for_file, [tmp_path / "never"])) == []
        monkeypatch.setattr(connection, "CONNECT_TIMEOUT_S", 0.5)
        with (
            pytest.raises(Unfinished, match="has no workers; start some"),
            workers(tmp_path / "stop", cluster=alone.address),
        ):
            pass


def test_the_points_of_a_scheduler_that_dies_are_kept_and_the_rest_swim_here(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "run"
    words = ("sweep", "square", "--frequency", "0.4:4:0.004", *SHORT_SWIM, "--folder", str(folder))
    with dask_cluster(tmp_path) as dying:
        dying.add_worker()
        with subprocess.Popen(
            [FISHCTL, *words, "--cluster", dying.address], stderr=subprocess.PIPE, text=True
        ) as sweep:
            wait_until(lambda: (folder / "rows.csv").exists() and len(rows(folder)) > 1)
            dying.scheduler.kill()
            _, errors = sweep.communicate(timeout=PATIENCE)
    assert (sweep.returncode, errors.count("\n")) == (1, 1), errors
    assert f"{dying.address}: its scheduler has ended, or cannot be reached; resume w" in errors
    kept = rows(folder)
    assert len(kept) > 1
    done = fishctl("sweep", "--resume", str(folder), "--frequency", "0.4,5", "--jobs", "1")
    assert (done.returncode, done.stderr) == (0, "")
    assert {*kept} < {*rows(folder)}
