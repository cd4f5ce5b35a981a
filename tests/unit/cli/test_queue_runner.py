"""The runner of a queue, its stops and a terminal that is gone, and the end that a queue shows."""

from pathlib import Path

import pytest

from fishd.cli import queue_runner
from fishd.cli.queue import show_queue
from fishd.cli.queue_runner import QueueRunner
from fishd.core.console import INTERRUPTED
from fishd.core.experiment_queue import QueueFile


@pytest.fixture
def runner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> QueueRunner:
    """Return the runner of a queue with one experiment, for a fish that answers."""
    file = QueueFile(tmp_path, "ipc:///tmp/fish/control")
    with file.changing() as queue:
        queue.add(["measure", "swing"], 1, 60.0)
    monkeypatch.setattr(QueueRunner, "_find_problem", lambda _: "")
    return QueueRunner(file)


@pytest.mark.slow
def test_a_stop_while_a_run_is_starting_is_not_its_failure(
    runner: QueueRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start_and_stop(_: object) -> list[str]:
        runner._stop()
        return ["sleep", "600"]  # has no handler of SIGTERM, as Python before its first import

    monkeypatch.setattr(queue_runner, "fishctl_command", start_and_stop)
    assert runner.run() == INTERRUPTED
    queue = runner._file.read()
    assert (queue.reason, queue.current, len(queue.items)) == ("it was stopped", None, 1)
    assert [past.outcome for past in queue.past] == ["stopped"]


@pytest.mark.slow
def test_a_terminal_that_is_gone_does_not_end_the_queue(
    runner: QueueRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(queue_runner, "echo", fail)
    monkeypatch.setattr(queue_runner, "fishctl_command", lambda _: ["sh", "-c", "echo x >&2"])
    assert runner.run() == 0
    queue = runner._file.read()
    assert (queue.items, [past.outcome for past in queue.past]) == ([], ["done"])


def test_the_end_of_a_queue_that_takes_longer_than_a_calendar_is_not_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = QueueFile(tmp_path, "ipc:///tmp/fish/control")
    with file.changing() as queue:
        queue.add(["measure", "swing"], 1, 1e14)
    show_queue(file, as_json=False)
    assert capsys.readouterr().out.endswith("start'; about 27777777777.8 h\n")
