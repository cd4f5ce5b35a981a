"""One training with several seeds: in parallel, on a cluster, and when something goes wrong."""

import csv
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("joblib", reason="the extra 'learn' is not installed")
pytest.importorskip("stable_baselines3", reason="the extra 'learn' is not installed")
pytest.importorskip("tensorboard", reason="the extra 'learn' is not installed")

from processes import FISHCTL

from fishd.learning.seed_table import COLUMNS, curve, write_summary

PATIENCE = 120.0
SETTINGS = """\
steps: {steps}
checkpoint_every: 128
ppo: {{n_steps: 64, n_epochs: 2}}
evaluation: {{seconds: 4.0, settle: 2.0}}
"""
LONG = 1_000_000


def command(folder: Path, *arguments: str, steps: int = 128) -> list[str]:
    settings = folder / "settings.yaml"
    settings.write_text(SETTINGS.format(steps=steps), encoding="utf-8")
    given = ["--settings", str(settings), "--folder", str(folder / "run")]
    return [FISHCTL, "learn", "ppo", *given, *arguments]


def finished(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(folder, *arguments), capture_output=True, text=True, check=False, timeout=PATIENCE
    )


def wait_for(what: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def evaluated(folder: Path) -> bool:
    return len(curve(folder)) >= 2


def members(session: int) -> list[int]:
    """The processes of a session."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            found.append(int(entry.name))
    return found


def trainers(session: int) -> list[int]:
    """Those of them that train."""

    def trains(process: int) -> bool:
        try:
            return b"popen_loky" in Path(f"/proc/{process}/cmdline").read_bytes()
        except OSError:
            return False

    return [process for process in members(session) if trains(process)]


@contextmanager
def started(folder: Path, *arguments: str, steps: int) -> Iterator[subprocess.Popen[str]]:
    """In a session of its own, as from a terminal; nothing of it is left behind."""
    process = subprocess.Popen(
        command(folder, *arguments, steps=steps),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    try:
        yield process
    finally:
        for member in members(process.pid):
            os.kill(member, signal.SIGKILL)
        process.communicate()


def test_every_seed_has_a_folder_and_all_of_them_a_table(tmp_path: Path) -> None:
    done = finished(tmp_path, "--seeds", "2", "--jobs", "2", "--seed", "5")
    assert (done.returncode, done.stderr) == (0, "")
    assert "seed 5" in done.stdout
    assert "seed 6" in done.stdout
    run = tmp_path / "run"
    with (run / "seeds.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["steps"] for row in rows] == ["64", "128"]
    first, second = (curve(run / f"seed-{index}") for index in (0, 1))
    assert first != second
    assert float(rows[-1]["lowest"]) == min(first[-1].efficiency, second[-1].efficiency)
    assert float(rows[-1]["best_highest"]) == max(first[-1].best, second[-1].best)


def test_a_seed_that_fails_is_reported_and_the_others_go_on(tmp_path: Path) -> None:
    from fishd.config import load
    from fishd.learning import settings as training
    from fishd.learning.jobs import Job
    from fishd.learning.seeds import SeedOutcome, train_seeds

    file = tmp_path / "settings.yaml"
    file.write_text(SETTINGS.format(steps=128), encoding="utf-8")
    folder = tmp_path / "run"
    job = Job(config=load(), settings=training.load(file), folder=folder)

    def put_something_in_the_way(outcome: SeedOutcome) -> None:
        if outcome.seed == 0:
            (folder / "seed-2").write_text("in the way")

    found = train_seeds(job, 4, jobs=1, ended=put_something_in_the_way)
    assert [outcome.ended for outcome in found] == ["finished", "finished", "failed", "finished"]
    assert "seed-2" in found[2].message
    assert len((folder / "seeds.csv").read_text().splitlines()) == 3


def test_ctrl_c_ends_all_of_them_with_a_checkpoint_each(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with started(tmp_path, "--seeds", "3", "--jobs", "2", steps=LONG) as process:
        wait_for(lambda: evaluated(run / "seed-0") and evaluated(run / "seed-1"))
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: parent and children
        _, errors = process.communicate(timeout=PATIENCE)
        assert process.returncode == 130
        wait_for(lambda: not members(process.pid))
    assert "Traceback" not in errors
    assert errors.count("interrupted") == 3
    assert all(list((run / f"seed-{index}").glob("step-*")) for index in (0, 1))
    assert not (run / "seed-2").exists()
    assert (run / "seeds.csv").exists()


def test_ctrl_c_before_any_has_begun_is_heeded_as_well(tmp_path: Path) -> None:
    with started(tmp_path, "--seeds", "3", "--jobs", "2", steps=LONG) as process:
        wait_for(lambda: trainers(process.pid))  # which have all to import as yet
        time.sleep(0.1)
        os.killpg(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=PATIENCE)
        assert process.returncode == 130
        wait_for(lambda: not members(process.pid))
    assert "Traceback" not in errors
    assert errors.count("interrupted (it had not begun)") == 3


def test_a_process_that_is_killed_costs_no_seed(tmp_path: Path) -> None:
    run = tmp_path / "run"
    with started(tmp_path, "--seeds", "2", "--jobs", "2", steps=2048) as process:
        wait_for(lambda: list((run / "seed-0").glob("step-*")))
        os.kill(trainers(process.pid)[0], signal.SIGKILL)
        output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors
    assert "latest policies of 2 seeds" in output
    assert [point.steps for point in curve(run / "seed-0")] == list(range(64, 2049, 64))


def test_a_folder_that_is_in_use_is_left_alone(tmp_path: Path) -> None:
    kept = tmp_path / "run" / "seed-0" / "policy"
    kept.parent.mkdir(parents=True)
    kept.write_text("of last week")
    done = finished(tmp_path, "--seeds", "2")
    assert "is there already; give another --folder" in done.stderr
    assert (done.returncode, done.stderr.count("\n")) == (78, 1)
    assert kept.read_text() == "of last week"


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[str]:
    """A Dask scheduler and one worker, processes of their own on the loopback interface."""
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    elsewhere = tmp_path / "worker"
    elsewhere.mkdir()
    here = ["--host", "127.0.0.1", "--no-dashboard"]
    port = address.rpartition(":")[2]
    one = ["--nworkers", "1", "--nthreads", "1", "--no-nanny", "--death-timeout", "60"]
    commands = (["scheduler", "--port", port, *here], ["worker", address, *one, *here])
    processes = [
        subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{kind}", *rest],
            cwd=elsewhere,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for kind, *rest in commands
    ]
    try:
        wait_for(lambda: has_worker(address))
        yield address
    finally:
        for process in reversed(processes):
            process.kill()
            process.wait()


def has_worker(address: str) -> bool:
    """Asked by another process: a client of Dask warns of much, and warnings are errors here."""
    program = (
        "import sys; from distributed import Client\n"
        "with Client(sys.argv[1], timeout=5) as client:\n"
        "    sys.exit(not client.scheduler_info()['workers'])\n"
    )
    asked = subprocess.run([sys.executable, "-c", program, address], capture_output=True)
    return asked.returncode == 0


def test_a_cluster_trains_what_this_machine_would_and_sends_it_back(
    tmp_path: Path, cluster: str
) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    for folder, options in ((here, ["--jobs", "1"]), (there, ["--cluster", cluster])):
        folder.mkdir()
        done = finished(folder, "--seeds", "2", *options)
        assert (done.returncode, done.stderr) == (0, "")
    for index in (0, 1):
        one, other = (folder / "run" / f"seed-{index}" for folder in (here, there))
        assert curve(one) == curve(other) != []
        assert (other / "step-000128" / "model.zip").is_file()
    summaries = [(folder / "run" / "seeds.csv").read_text() for folder in (here, there)]
    assert summaries[0] == summaries[1]


def test_a_cluster_that_does_not_answer_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    done = finished(tmp_path, "--seeds", "2", "--cluster", "tcp://127.0.0.1:1")
    assert "no Dask scheduler answers at tcp://127.0.0.1:1" in done.stderr
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert not (tmp_path / "run").exists()


def test_a_summary_of_seeds_that_got_nowhere_is_a_head(tmp_path: Path) -> None:
    write_summary(tmp_path / "seeds.csv", [tmp_path / "seed-0"])
    assert (tmp_path / "seeds.csv").read_text() == ",".join(COLUMNS) + "\n"
