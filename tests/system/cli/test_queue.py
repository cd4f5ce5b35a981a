"""`fishctl queue`: what it checks, runs and leaves, and how it pauses."""

import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
from rigs.processes import EXPERIMENT, Daemon, Process, call, one_line, wait_until

from fishd.core.experiment_queue import QueueFile

SIMULATED = ("measure", "swing", "--for", "21", "--on", "simulation")
"""An experiment on a simulated fish, which takes a second."""
LIVE = ("measure", "square", "--for", "60")

ADD = """
import sys
from pathlib import Path
from fishd.core.experiment_queue import QueueFile
for _ in range(40):
    with QueueFile(Path(sys.argv[1]), sys.argv[2]).changing() as queue:
        queue.move(queue.add([sys.argv[3]], 1, None).id, 1)
"""


class Terminal:
    """A terminal in which a queue is changed and run."""

    def __init__(self, daemon: Daemon, runs: Path) -> None:
        self.daemon, self.runs = daemon, runs
        self.file = QueueFile(runs, daemon.endpoint)

    def queue(self, *words: str) -> str:
        """Return what a verb prints that is carried out."""
        done = self.daemon.fishctl("queue", *words)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout

    def view(self) -> Any:
        return json.loads(self.queue("list", "--json"))

    def start(self) -> Process:
        """Start the runner, in another process."""
        return Process(*EXPERIMENT, "--endpoint", self.daemon.endpoint, "queue", "start")

    def run(self) -> tuple[int, str]:
        """Run the queue; return exit status and standard error."""
        done = call(*EXPERIMENT, "--endpoint", self.daemon.endpoint, "queue", "start")
        return done.returncode, done.stderr

    def start_live(self) -> Process:
        """Start the runner, and wait until the fish swims."""
        runner = self.start()
        wait_until(lambda: self.daemon.status().mode == "running")
        return runner


@pytest.fixture
def terminal(daemon: Daemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Terminal:
    """Return a terminal with an empty queue."""
    monkeypatch.setenv("FISHD_RUNS", str(tmp_path / "runs"))
    return Terminal(daemon, tmp_path / "runs")


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("measure swng", "did you mean 'swing'?"),
        ("measure swing --C 7", "C: 7.0 is not valid: a number in [0, 1]"),
        ("measure swing --c 0.6", "No such option '--c'"),
        ("measure swing --for 3", "20.25 to 3600 s are needed"),
        ("measure thrust", "target"),
        ("sweep square frequency=2:1:0.1", "frequency"),
        ("sweep square amplitude=0.3,0.6", "amplitude_limit"),
        ("sweep square --vary plant.xi=1,2", "--vary is for --on simulation"),
        ("compare swing swng", "swng"),
        ("optimise square --frequency 1:3 --budget 5", "a budget of 5 s is too short"),
        ("identify --experiment --fit colour", "colour"),
        ("identify latest", "'identify latest' is not an experiment; a queue takes: measure, "),
        ("learn ppo --settings none.yaml", "none.yaml"),
        ("learn ppo --on live --seeds 2", "there is only one live fish"),
        ("learn export run", "'learn export run' is not an experiment"),
        ("record", "'record' is not an experiment"),
        ("measure swing --folder here", "--folder is chosen by the queue"),
        ("-- measure swing --help", "--help is chosen by the queue"),
        ("measure swing --take", "--take is chosen by the queue"),
        ("--repeat 0 measure swing", "--repeat"),
        ("measure swing --repeat many", "--repeat"),
    ],
)
def test_what_would_fail_at_night_is_refused_when_it_is_added(
    terminal: Terminal, words: str, complaint: str
) -> None:
    assert complaint in one_line(terminal.daemon.fishctl("queue", "add", *words.split()))
    assert not terminal.runs.exists()


def test_an_experiment_is_checked_while_another_one_swims_the_fish_and_disturbs_nothing(
    terminal: Terminal,
) -> None:
    with Process(*EXPERIMENT, "--endpoint", terminal.daemon.endpoint, *LIVE) as measuring:
        wait_until(lambda: terminal.daemon.status().mode == "running")
        added = json.loads(terminal.queue("add", *LIVE, "--repeat", "3", "--json"))
        assert (added["words"], added["repeat"], added["seconds"]) == ([*LIVE], 3, 60.0)
        lease = terminal.daemon.status().lease
        assert lease
        assert lease.pid == measuring.pid
        assert measuring.end(signal.SIGINT)[0] == 130
    assert {path.suffix for path in terminal.runs.glob("queue*")} == {".json", ".lock"}


def test_an_experiment_is_added_while_no_fishd_runs(
    terminal: Terminal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FISHD_ENDPOINT", f"ipc://{tmp_path}/nothing")
    done = call(*EXPERIMENT, "queue", "add", "measure", "swing", "--json")
    assert json.loads(done.stdout)["seconds"] is None
    ended = call(*EXPERIMENT, "queue", "start")
    assert ended.returncode == 1
    assert "the queue pauses: no fishd at ipc:///" in ended.stderr


def test_a_queue_runs_in_order_repeats_and_leaves_runs_as_always(terminal: Terminal) -> None:
    terminal.queue("add", *SIMULATED, "--repeat", "2")
    terminal.queue("add", "measure", "square", *SIMULATED[2:])
    terminal.queue("move", "2", "1")
    status, err = terminal.run()
    assert status == 0, err
    assert err.splitlines()[-1] == "fishctl: the queue is empty"
    past = terminal.view()["past"]
    assert [entry["words"][1] for entry in past] == ["square", "swing", "swing"]
    for entry in past:
        assert entry["outcome"] == "done"
        result = json.loads((terminal.runs / entry["run"] / "result.json").read_text())
        assert entry["message"].startswith(f"{1e3 * result['thrust']:.2f} ± ")
    assert terminal.view()["state"] == "empty"
    assert one_line(terminal.daemon.fishctl("queue", "start")).startswith("fishctl: the queue is e")


def test_a_run_that_fails_pauses_the_queue_and_stays_its_first(
    terminal: Terminal, tmp_path: Path
) -> None:
    config = tmp_path / "fish.yaml"
    config.write_text("tick: 0.04\n")
    terminal.queue("add", *SIMULATED, "--config", str(config))
    terminal.queue("add", *SIMULATED)
    config.unlink()
    status, err = terminal.run()
    assert status == 1
    assert "the queue pauses: experiment 1 failed" in err.splitlines()[-1]
    view = terminal.view()
    assert (view["state"], [item["id"] for item in view["items"]]) == ("paused", [1, 2])
    assert "fish.yaml: no such file" in view["reason"]
    assert [entry["outcome"] for entry in view["past"]] == ["failed"]
    config.write_text("tick: 0.04\n")
    assert terminal.run()[0] == 0


def test_an_experiment_of_a_controller_that_has_gone_is_one_line(terminal: Terminal) -> None:
    with terminal.file.changing() as queue:  # it was added while its package was installed
        queue.add(["measure", "sculling"], 1, 60.0)
    status, _ = terminal.run()
    assert status == 1
    reason = terminal.view()["reason"]
    assert reason.startswith("experiment 1 failed: no controller is named 'sculling'")


def test_nothing_begins_while_the_fish_has_an_emergency_stop(terminal: Terminal) -> None:
    terminal.queue("add", *SIMULATED)
    terminal.daemon.fishctl("estop")
    status, err = terminal.run()
    assert status == 1
    assert "pauses: the fish is in mode estop" in err
    assert terminal.view()["past"] == []
    terminal.daemon.fishctl("clear-fault")
    assert terminal.run()[0] == 0


def test_an_emergency_stop_during_a_run_pauses_the_queue(terminal: Terminal) -> None:
    terminal.queue("add", *LIVE, "--repeat", "2")
    with terminal.start_live() as runner:
        terminal.daemon.fishctl("estop")
        assert runner.process.wait() == 1
    view = terminal.view()
    assert view["reason"].startswith("experiment 1 failed: ")
    assert view["items"][0]["repeat"] == 2


def test_what_is_interrupted_is_resumed_by_the_next_start(terminal: Terminal) -> None:
    terminal.queue("add", "measure", "square", "--for", "21")
    with terminal.start_live() as runner:
        assert runner.end(signal.SIGINT)[0] == 130
    assert terminal.daemon.status().mode == "idle"
    (item,) = terminal.view()["items"]
    folder = terminal.runs / item["run"]
    before = json.loads((folder / "experiment.json").read_text())
    assert not before["ended"]
    assert terminal.run()[0] == 0
    assert json.loads((folder / "experiment.json").read_text())["began"] == before["began"]
    assert [entry["outcome"] for entry in terminal.view()["past"]] == ["stopped", "done"]
    assert len(list(terminal.runs.glob("measure-*"))) == 1


def test_a_queue_pauses_on_request_now_or_after_the_run(terminal: Terminal) -> None:
    assert "the queue does not run" in one_line(terminal.daemon.fishctl("queue", "pause"))
    terminal.queue("add", *LIVE)
    with terminal.start_live() as runner:
        terminal.queue("pause")
        assert terminal.view()["pauses"]
        terminal.queue("pause", "--cancel")
        assert "pauses" not in terminal.queue("list")
        terminal.queue("pause", "--now")
        status, _, err = runner.process.wait(), *runner.process.communicate()
    assert status == 0
    assert "the queue pauses: it was to stop at " in err
    assert terminal.daemon.status().mode == "idle"


def test_a_queue_that_is_to_pause_begins_no_further_run(terminal: Terminal) -> None:
    terminal.queue("add", *SIMULATED, "--repeat", "3")
    with terminal.start() as runner:
        wait_until(lambda: terminal.view()["current"] == 1)
        terminal.queue("pause")
        assert runner.process.wait() == 0
    view = terminal.view()
    assert (view["reason"], view["pauses"]) == ("it was to pause after that run", False)
    assert len(view["past"]) + view["items"][0]["repeat"] == 3


def test_a_time_of_day_at_which_it_stops_is_the_next_one(terminal: Terminal) -> None:
    terminal.queue("add", *SIMULATED)
    shown = terminal.queue("pause", "--at", "18:00")
    assert "it stops at " in shown
    assert shown.rstrip().endswith("18:00")
    complaint = one_line(terminal.daemon.fishctl("queue", "pause", "--at", "6 pm"))
    assert "'6 pm' is not a time of day; write HH:MM" in complaint
    with terminal.file.changing() as queue:
        queue.pause(1.0)  # a time that has passed before the start
    assert terminal.run()[0] == 0


def test_a_runner_that_is_killed_leaves_the_fish_at_rest_and_its_queue_waiting(
    terminal: Terminal,
) -> None:
    terminal.queue("add", *LIVE)
    terminal.queue("add", *LIVE)
    with terminal.start_live() as runner:
        complaint = one_line(terminal.daemon.fishctl("queue", "start"))
        assert complaint == f"fishctl: process {runner.pid} runs this queue already\n"
        runner.end(signal.SIGKILL)
    wait_until(lambda: terminal.daemon.status().mode == "idle")
    wait_until(lambda: terminal.daemon.status().lease is None)
    view = terminal.view()
    assert (view["state"], view["current"]) == ("paused", None)
    assert "went down while experiment 1 ran" in view["reason"]
    assert "went down while experiment 1 ran" in terminal.queue("move", "2", "1")
    assert terminal.view()["items"][1]["run"] == view["items"][0]["run"] != ""


def test_no_change_is_lost_where_two_processes_change_a_queue_at_once(terminal: Terminal) -> None:
    words = (sys.executable, "-c", ADD, os.fspath(terminal.runs), terminal.daemon.endpoint)
    with Process(*words, "page") as page, Process(*words, "terminal") as other:
        assert (page.process.wait(), other.process.wait()) == (0, 0)
    items = terminal.file.read().items
    assert sorted(item.id for item in items) == list(range(1, 81))
    for name in ("page", "terminal"):
        own = [item.id for item in items if item.words == [name]]
        assert (len(own), own) == (40, sorted(own, reverse=True))
