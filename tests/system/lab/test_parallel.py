"""Computations on several processes, and the process that a Ctrl-C reaches."""

import os
import signal
from pathlib import Path
from typing import Any

import joblib
import pytest

from fishd.core.errors import FishdError
from fishd.core.process.interruption import on_signal
from fishd.lab import parallel
from fishd.lab.parallel import workers


def blocked(_: int) -> set[int]:
    return set(signal.pthread_sigmask(signal.SIG_BLOCK, ()))


def test_its_processes_leave_ctrl_c_and_hang_up_to_their_first_process(tmp_path: Path) -> None:
    with workers(tmp_path / "stop", jobs=2) as crew:
        for _, signals in crew.run(blocked, range(3)):
            assert signals == {signal.SIGINT, signal.SIGHUP}
    assert not blocked(0)


def test_a_cluster_has_one_connection_which_is_closed(tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")

    def connections() -> int:
        return sum(client.status != "closed" for client in distributed.Client._instances)

    here = {"host": "127.0.0.1", "protocol": "tcp://", "local_directory": str(tmp_path)}
    alone = {"processes": False, "n_workers": 1, "threads_per_worker": 1}
    with distributed.LocalCluster(**here, **alone, dashboard_address="127.0.0.1:0") as cluster:
        before = connections()
        with workers(tmp_path / "stop", cluster=cluster.scheduler_address) as crew:
            for _ in crew.run(abs, [-1, -2]):
                assert connections() == before + 1
        assert connections() == before


def test_what_one_that_was_killed_told_its_processes_does_not_stop_the_next(tmp_path: Path) -> None:
    stop = tmp_path / "stop"
    stop.touch()
    with workers(stop) as crew:
        is_asked = crew.stop.make_check()
        assert not is_asked()
        crew.ask_to_stop()
        assert is_asked()
    assert not stop.exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_while_its_processes_are_being_started_is_heard(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    heard: list[int] = []
    start = joblib.Parallel.__call__

    def interrupted(parallel: joblib.Parallel, calls: Any) -> Any:
        os.kill(os.getpid(), number)
        return start(parallel, calls)

    monkeypatch.setattr(joblib.Parallel, "__call__", interrupted)
    with on_signal(lambda: heard.append(number)), workers(tmp_path / "stop", jobs=2) as crew:
        assert sorted(crew.run(abs, [-1, -2])) == [(0, 1), (1, 2)]
    assert heard == [number]


def test_without_semaphores_one_line_says_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel, "multiprocessing", None)  # as where /dev/shm cannot be written
    with (
        pytest.raises(FishdError, match=r"/dev/shm is missing or not writable; mount it: "),
        workers(tmp_path / "stop"),
    ):
        pass
