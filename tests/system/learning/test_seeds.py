"""A training with several seeds: in parallel, on a cluster, and with failures.

Training processes take seconds to import torch, so those of this process stay for the next test.
"""

import csv
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from joblib.externals.loky import get_reusable_executor
from msgspec.structs import replace
from rigs.dask_cluster import dask_cluster
from rigs.processes import FISHCTL, fishctl, is_stopped
from rigs.swimming import LONG_ENOUGH, Done, brief_job, wait_for, while_it_trains

from fishd.lab.parallel import FileStop
from fishd.learning.run_folder.checkpoints import newest, read_card
from fishd.learning.run_folder.tables import SUMMARY, best_so_far, read_evaluations, write_summary
from fishd.learning.train.seeds import _Task, _train, _train_remotely, pack, unpack

SETTINGS = """\
steps: {steps}
checkpoint_every: 128
ppo: {{n_steps: 64, n_epochs: 2, log_std_init: 0.7}}
evaluation: {{every: 1, patience: null, seconds: 4.0, settle: 2.0}}
"""
MANY_STEPS = 1_000_000


def command(folder: Path, *arguments: str, steps: int = 128) -> list[str]:
    settings = folder / "settings.yaml"
    settings.write_text(SETTINGS.format(steps=steps), encoding="utf-8")
    options = ["--settings", str(settings), "--folder", str(folder / "run")]
    return ["learn", "ppo", *options, *arguments]


@pytest.fixture(scope="module", autouse=True)
def _own_trainers() -> Iterator[None]:
    """Train in new processes: joblib ends one that needs 300 MB more than after its first task."""
    end_trainers()
    yield
    end_trainers()


def end_trainers() -> None:
    get_reusable_executor(reuse=True).shutdown(kill_workers=True)


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Done]:
    """The run folder, which must not be changed, and the output of two seeds in two processes."""
    folder = tmp_path_factory.mktemp("two")
    words = ("--seeds", "2", "--jobs", "2", "--seed", "5", "--plot", str(folder / "seeds.png"))
    done = fishctl(*command(folder, *words))
    return folder / "run", done


def evaluated(folder: Path) -> bool:
    return len(read_evaluations(folder)) >= 2


def processes(field: int, number: int) -> list[int]:
    """Return the processes with `number` in a field of /proc/PID/stat, counted after the name."""
    pids = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[field]) == number and fields[0] != "Z":
            pids.append(int(entry.name))
    return pids


def members(session: int) -> list[int]:
    return processes(3, session)


def trainers(parent: int) -> list[int]:
    """Return the training processes of a parent."""

    def trains(process: int) -> bool:
        try:
            return b"popen_loky" in Path(f"/proc/{process}/cmdline").read_bytes()
        except OSError:
            return False

    return [process for process in processes(1, parent) if trains(process)]


@contextmanager
def started(folder: Path, *arguments: str, steps: int) -> Iterator[subprocess.Popen[str]]:
    """Run a training in a new session, as from a terminal, and kill its processes at the end."""
    process = subprocess.Popen(
        [FISHCTL, *command(folder, *arguments, steps=steps)],
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
        process.communicate(timeout=LONG_ENOUGH)


def test_every_seed_has_a_folder_and_all_share_a_table(two: tuple[Path, Done]) -> None:
    run, done = two
    assert (done.returncode, done.stderr) == (0, "")
    assert "seed 5" in done.stdout
    assert "seed 6" in done.stdout
    assert "latest policies of 2 seeds" in done.stdout
    with (run / "seeds.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["steps"] for row in rows] == ["0", "64", "128"]
    assert (run.parent / "seeds.png").read_bytes().startswith(b"\x89PNG")
    first, second = (read_evaluations(run / f"seed-{index}") for index in (0, 1))
    assert first != second
    assert float(rows[-1]["lowest"]) == min(first[-1].relative_thrust, second[-1].relative_thrust)
    assert float(rows[-1]["best_highest"]) == max(best_so_far(first)[-1], best_so_far(second)[-1])


def test_a_seed_that_fails_is_reported_and_the_others_continue(tmp_path: Path) -> None:
    from fishd.config import load
    from fishd.learning import settings as training
    from fishd.learning.train.jobs import Job, Outcome
    from fishd.learning.train.seeds import train_seeds

    file = tmp_path / "settings.yaml"
    file.write_text(SETTINGS.format(steps=128), encoding="utf-8")
    folder = tmp_path / "run"
    job = Job(config=load(), settings=training.load(file), folder=folder)

    def block_folder(seed: int, outcome: Outcome) -> None:
        if seed == 0:
            (folder / "seed-2").write_text("a file, not a folder")

    outcomes = train_seeds(job, 4, jobs=1, ended=block_folder)
    assert [outcome.ended for outcome in outcomes] == ["finished", "finished", "failed", "finished"]
    assert "seed-2" in outcomes[2].message
    assert len((folder / "seeds.csv").read_text().splitlines()) == 4


def test_ctrl_c_ends_all_seeds_with_a_checkpoint_each(tmp_path: Path) -> None:
    run = tmp_path / "run"

    def press() -> None:  # a terminal sends the signal to parent and children
        for process in (*trainers(os.getpid()), os.getpid()):
            os.kill(process, signal.SIGINT)

    done = while_it_trains(
        lambda: evaluated(run / "seed-0") and evaluated(run / "seed-1"),
        press,
        *command(tmp_path, "--seeds", "3", "--jobs", "2", steps=MANY_STEPS),
    )
    assert done.returncode == 130
    assert "Traceback" not in done.stderr
    assert done.stderr.count("interrupted") == 4
    assert "interrupted, 0 of 3 seeds are finished; resume with: fishctl learn" in done.stderr
    assert all(list((run / f"seed-{index}").glob("step-*")) for index in (0, 1))
    assert not (run / "seed-2").exists()
    assert (run / "seeds.csv").exists()


STOP_TRAINERS = """\
import os, signal, sys
if any("popen_loky" in word for word in sys.orig_argv):
    os.kill(os.getpid(), signal.SIGSTOP)
"""
"""Code run at the start of each Python process: a trainer waits for SIGCONT before it imports."""


def test_ctrl_c_before_any_training_has_begun_ends_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sitecustomize.py").write_text(STOP_TRAINERS)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with started(tmp_path, "--seeds", "3", "--jobs", "2", steps=MANY_STEPS) as process:
        wait_for(lambda: sum(map(is_stopped, trainers(process.pid))) == 2)
        waiting = trainers(process.pid)
        os.killpg(process.pid, signal.SIGINT)
        wait_for((tmp_path / "run" / "stop").exists)
        for trainer in waiting:
            os.kill(trainer, signal.SIGCONT)
        _, errors = process.communicate(timeout=LONG_ENOUGH)
        assert process.returncode == 130
        wait_for(lambda: not members(process.pid))
    assert "Traceback" not in errors
    assert errors.count("interrupted (it had not begun)") == 3


def test_the_seed_of_a_killed_process_is_resumed(tmp_path: Path) -> None:
    run = tmp_path / "run"
    done = while_it_trains(
        lambda: list((run / "seed-0").glob("step-*")),
        lambda: os.kill(trainers(os.getpid())[0], signal.SIGKILL),
        *command(tmp_path, "--seeds", "2", "--jobs", "2", steps=256),
    )
    assert done.returncode == 0, done.stderr
    assert "latest policies of 2 seeds" in done.stdout
    evaluations = read_evaluations(run / "seed-0")
    assert [evaluation.steps for evaluation in evaluations] == list(range(0, 257, 64))


def test_a_finished_seed_whose_outcome_was_lost_is_finished(tmp_path: Path) -> None:
    """If one process is killed, all are, so a seed that has just finished is run again."""
    job = brief_job(tmp_path / "seed-0")
    first = _train(job, lambda: False)
    assert first.ended == "finished"
    (job.folder / ".step-000128.part").mkdir()
    assert _train(job, lambda: False) == first
    assert not list(job.folder.glob(".*"))


@pytest.mark.parametrize("name", ["seed-0/policy", "stop"])
def test_a_folder_that_is_in_use_is_not_changed(tmp_path: Path, name: str) -> None:
    file = tmp_path / "run" / name
    file.parent.mkdir(parents=True)
    file.write_text("of last week")
    done = fishctl(*command(tmp_path, "--seeds", "2"))
    assert "the folder is not empty; choose another with --folder" in done.stderr
    assert (done.returncode, done.stderr.count("\n")) == (78, 1)
    assert file.read_text() == "of last week"


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[str]:
    """The address of a Dask scheduler with one worker, processes on the loopback interface."""
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    elsewhere = tmp_path / "worker"
    elsewhere.mkdir()
    with dask_cluster(elsewhere) as running:
        running.add_worker()
        yield running.address


def test_a_cluster_trains_the_seeds_that_are_missing_as_this_machine_does(
    tmp_path: Path, cluster: str, two: tuple[Path, Done]
) -> None:
    here, there = two[0], tmp_path / "run"
    shutil.copytree(here, there)
    shutil.rmtree(there / "seed-1")
    (there / "seeds.csv").unlink()
    finished = sorted((there / "seed-0").rglob("*"))
    done = fishctl("learn", "ppo", "--resume", str(there), "--cluster", cluster)
    assert (done.returncode, done.stderr) == (0, "")
    assert sorted((there / "seed-0").rglob("*")) == finished, "it was trained again"
    assert read_evaluations(here / "seed-1") == read_evaluations(there / "seed-1") != []
    assert (there / "seed-1" / "step-000128" / "model.zip").is_file()
    assert (here / "seeds.csv").read_text() == (there / "seeds.csv").read_text()


def test_a_worker_needs_no_folder_of_this_machine(tmp_path: Path, two: tuple[Path, Done]) -> None:
    """The networks that a training begins with are sent to it."""
    parent = two[0] / "seed-0" / "step-000128"
    elsewhere = tmp_path / "another machine" / "seed-0" / "step-000128"
    job = replace(brief_job(tmp_path / "another machine" / "run"), parent=elsewhere)
    outcome, files = _train_remotely(_Task(job, FileStop(tmp_path / "stop"), parent=pack(parent)))
    assert (outcome.ended, outcome.message) == ("finished", "")
    unpack(files, tmp_path / "run")
    note = read_card(newest(tmp_path / "run")).provenance.note
    assert note.startswith("began with seed-0/step-000128, 128 steps")


def test_a_cluster_that_does_not_answer_is_one_line_with_the_command_to_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="the extra 'cluster' is not installed")
    from fishd.lab import cluster

    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT_S", 0.2)
    done = fishctl(*command(tmp_path, "--seeds", "2", "--cluster", "tcp://127.0.0.1:1"))
    assert "no Dask scheduler answers at tcp://127.0.0.1:1" in done.stderr
    assert f"resume with: fishctl learn ppo --resume {tmp_path / 'run'}; add" in done.stderr
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)


def test_a_summary_repeats_the_last_figures_of_a_seed_that_ended_early(tmp_path: Path) -> None:
    table = "steps,thrust,relative_thrust,frequency,fullness,is_stalled,best\n"
    rows = [f"{steps},0.02,0.{steps},1.7,1,0,1\n" for steps in (64, 72, 80)]
    for name, lines in (("short", rows[:1]), ("long", rows)):
        (tmp_path / name).mkdir()
        (tmp_path / name / "evaluations.csv").write_text(table + "".join(lines))
    write_summary(tmp_path / "seeds.csv", [tmp_path / "short", tmp_path / "long"])
    summary = csv.DictReader((tmp_path / "seeds.csv").read_text().splitlines())
    assert [(row["seeds"], row["lowest"], row["best_highest"]) for row in summary] == [
        ("2", "0.64", "0.64"),
        ("2", "0.64", "0.72"),
        ("2", "0.64", "0.8"),
    ]


def test_a_summary_of_seeds_without_evaluations_is_a_head(tmp_path: Path) -> None:
    write_summary(tmp_path / "seeds.csv", [tmp_path / "seed-0"])
    assert (tmp_path / "seeds.csv").read_text() == ",".join(SUMMARY) + "\n"
