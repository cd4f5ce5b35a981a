"""Run folders after kills, full disks and damage, with odd files and two trainings at once."""

import os
import shutil
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import pytest
from msgspec.structs import replace
from rigs.kills import ends_before
from rigs.swimming import brief_job, rows

from fishd.core.errors import ConfigError, FishdError
from fishd.learning import settings as training
from fishd.learning.env.evaluation import Evaluation
from fishd.learning.run_folder import checkpoints, runs
from fishd.learning.run_folder.checkpoints import CheckpointError
from fishd.learning.run_folder.tables import Table, read_evaluations
from fishd.learning.settings import EvaluationSettings
from fishd.learning.train.jobs import Outcome
from fishd.learning.train.progress import Display
from fishd.learning.train.training import train

TIMEOUT_S = 60.0
STEP = "step-000064"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of 64 steps, which must not be changed."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    train(brief_job(folder, steps=64))
    return folder


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy of the finished run, to be damaged."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


def resumed(run: Path, **changes: Any) -> Outcome:
    """Train a run for another 64 steps."""
    return train(brief_job(run, resume=True, **{"steps": 128, **changes}))


def pipe(path: Path) -> None:
    os.mkfifo(path)


def endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


READERS: dict[str, Callable[[Path], object]] = {
    "config.yaml": lambda run: runs.read(run),
    "settings.yaml": lambda run: training.load(run / "settings.yaml"),
    f"{STEP}/card.json": lambda run: checkpoints.load_policy(run / STEP),
    f"{STEP}/state.json": lambda run: checkpoints.read_state(run / STEP),
    f"{STEP}/model.zip": lambda run: checkpoints.load_policy(run / STEP),
    "progress.csv": lambda run: Table(run / "progress.csv", ("steps",)).keep_until(64),
    "evaluations.csv": read_evaluations,
}


def complaint(read: Callable[[Path], object], run: Path) -> str:
    """Return the message of the error that a reader must raise within `TIMEOUT_S`."""
    messages: list[str] = []

    def read_once() -> None:
        try:
            read(run)
        except FishdError as error:
            messages.append(str(error))

    reader = threading.Thread(target=read_once, daemon=True)
    reader.start()
    reader.join(TIMEOUT_S)
    assert messages, "the reader does not end, or accepts the file"
    assert "\n" not in messages[0]
    return messages[0]


@pytest.mark.parametrize("plant", [pipe, endless])
@pytest.mark.parametrize("name", READERS)
def test_a_pipe_or_a_device_in_place_of_a_file_is_one_line_at_once(
    run: Path, name: str, plant: Callable[[Path], None]
) -> None:
    (run / name).unlink()
    plant(run / name)
    message = complaint(READERS[name], run)
    if name == "progress.csv":  # it can be replaced by a new one
        assert "not a table of a training; move it away" in message
    else:
        kind = "a named pipe" if plant is pipe else "a device"
        assert message.startswith(f"{run / name}: is {kind}; a regular file is needed")


@pytest.mark.parametrize("key", ["on", "x"])
@pytest.mark.parametrize(
    ("name", "message"),
    [("state.json", "move this checkpoint away"), ("card.json", "nested too deeply")],
)
def test_endlessly_nested_json_is_one_line(run: Path, name: str, message: str, key: str) -> None:
    reader = READERS[f"{STEP}/{name}"]
    for depth in (60, 900, 9000):
        text = f'{{"{key}":' * depth + "1" + "}" * depth
        (run / STEP / name).write_text(text, encoding="utf-8")
        assert message in complaint(reader, run)


@pytest.mark.parametrize("text", ["", "{", "[]", "\0" * 99])
def test_a_damaged_card_is_one_line_with_a_remedy(run: Path, text: str) -> None:
    card = run / STEP / "card.json"
    card.write_text(text, encoding="utf-8")
    message = complaint(READERS[f"{STEP}/card.json"], run)
    assert message.startswith(f"{card}: its card is not ")
    assert message.endswith("; move this checkpoint away to resume from the previous one")


def test_an_archive_that_would_fill_the_memory_is_refused(run: Path) -> None:
    with ZipFile(run / STEP / "model.zip", "w", ZIP_DEFLATED, compresslevel=1) as archive:
        for number in range(5):
            archive.writestr(f"{number}.pth", bytes(64 * 2**20))
    read_model = READERS[f"{STEP}/model.zip"]
    assert "it unpacks to far more than a checkpoint needs" in complaint(read_model, run)


def test_a_checkpoint_with_a_strange_number_is_not_the_newest(run: Path) -> None:
    (run / "step-²").mkdir()
    assert checkpoints.newest(run).name == STEP


def save_best(run: Path, state: checkpoints.State) -> None:
    """Save the networks of the run again, as the best ones."""
    content = (run / STEP / "model.zip").read_bytes()
    model: Any = SimpleNamespace(save=lambda archive: archive.write(content))
    checkpoints.save(run, "best", model, checkpoints.read_card(run / STEP), state)


@pytest.mark.parametrize("steps", [64, 32], ids=["of the same name", "of another name"])
def test_after_a_kill_at_any_call_of_a_save_the_best_is_the_new_or_the_old_one(
    finished: Path, tmp_path: Path, steps: int
) -> None:
    for call in count():
        run = Path(shutil.copytree(finished, tmp_path / f"{call}"))
        before = replace(checkpoints.read_state(run / STEP), tank_time=1.0)
        save_best(run, before)
        after = replace(before, steps=steps, tank_time=9.0)
        ended = ends_before(call, partial(save_best, run, after))
        checkpoints.remove_partial(run)
        best = checkpoints.best(run)
        state = checkpoints.read_state(best)
        assert (state.steps, state.tank_time) in ((64, 1.0), (steps, 9.0))
        assert checkpoints.load_policy(best)
        assert not list(run.glob(".*"))
        if ended:
            assert state.tank_time == 9.0
            break


def test_the_best_is_the_one_that_was_saved_last_whatever_the_clock_was(
    finished: Path, tmp_path: Path
) -> None:
    run = Path(shutil.copytree(finished, tmp_path / "run"))
    state = checkpoints.read_state(run / STEP)
    save_best(run, state)
    shutil.copytree(run / "best-000064", tmp_path / "before")
    save_best(run, replace(state, steps=32))
    (tmp_path / "before").rename(run / "best-000064")  # left by a kill before it was removed
    os.utime(run / "best-000032" / "state.json", (0.0, 0.0))
    assert checkpoints.best(run) == run / "best-000032"


def test_a_table_of_another_kind_is_one_line(run: Path) -> None:
    (run / "evaluations.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    file = run / "evaluations.csv"
    remedy = "move it away, and a new one is begun"
    assert complaint(read_evaluations, run) == f"{file}: not a table of evaluations; {remedy}"


def test_a_kill_between_table_and_checkpoint_leaves_no_gap(tmp_path: Path) -> None:
    """After an abrupt end of a run, its newest checkpoint is not newer than its tables."""
    job = brief_job(tmp_path / "run", steps=256)

    class Killed(Display):
        def evaluated(self, evaluation: Evaluation) -> None:
            if evaluation.steps == 192:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(job, Killed())
    train(replace(job, resume=True))
    updates = ["64", "128", "192", "256"]
    for name, steps in (("progress.csv", updates), ("evaluations.csv", ["0", *updates])):
        assert [row["steps"] for row in rows(job.folder / name)] == steps


def test_a_row_cut_off_by_a_kill_is_dropped_even_if_only_a_digit_is_missing(run: Path) -> None:
    table = Table(run / "table.csv", ("steps", "std"))
    for steps in (64, 128):
        table.add({"steps": steps, "std": 0.75})
    table.path.write_bytes(table.path.read_bytes()[:-2])
    table.keep_until(128)
    assert table.path.read_text() == "steps,std\n64,0.75\n"
    with (run / "evaluations.csv").open("a", encoding="utf-8") as file:
        file.write("128,0.")
    assert [evaluation.steps for evaluation in read_evaluations(run)] == [0, 64]


def test_a_run_in_progress_is_not_resumed_by_another(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run", steps=256)
    refusals = []

    def resume_too() -> bool:
        with pytest.raises(ConfigError, match=f"is being trained in, by process {os.getpid()}"):
            train(replace(job, resume=True))
        refusals.append(True)
        return True

    train(job, stop=resume_too)
    assert refusals
    assert train(replace(job, resume=True)).ended == "finished"
    assert not list(job.folder.glob("*.lock"))


@pytest.mark.parametrize("until", ["", "plant:", "ppo:"])
def test_a_file_of_a_run_that_was_cut_off_has_no_defaults_added(run: Path, until: str) -> None:
    file = run / (runs.CONFIG if until == "plant:" else runs.SETTINGS)
    text = file.read_text(encoding="utf-8")
    file.write_text(text[: text.index(until)], encoding="utf-8")
    with pytest.raises(ConfigError, match=f"{file.name}: .*(the key [a-z_]+ is missing|needed)"):
        runs.read(run)


def test_a_resume_with_another_fish_or_other_networks_is_refused(run: Path) -> None:
    job = brief_job(run, resume=True, steps=128)
    settings = job.settings
    wider = replace(job.config, amplitude_limit=0.3)
    relu = replace(settings, ppo=replace(settings.ppo, activation="relu"))
    blind = replace(settings, environment=replace(settings.environment, force_scale=2.0))
    for config, changed, message in (
        (wider, settings, "its observation, or a scale of it, differs"),
        (job.config, blind, "its observation, or a scale of it, differs"),
        (job.config, relu, "its ppo.activation is tanh, that of this training is relu"),
    ):
        with pytest.raises(CheckpointError, match=message):
            train(replace(job, config=config, settings=changed))
    assert train(job).ended == "finished"


@pytest.mark.parametrize("content", ["", "a,b\n1,2\n", "steps\nmany\n", "\xff\x00"])
def test_a_file_that_is_not_a_table_is_one_line_and_may_be_moved(run: Path, content: str) -> None:
    table = run / "progress.csv"
    table.write_bytes(content.encode("latin-1"))
    with pytest.raises(CheckpointError, match="not a table of a training; move it away"):
        resumed(run)
    table.unlink()
    assert resumed(run).ended == "finished"


@pytest.mark.parametrize("part", ["policy.pth", "policy.optimizer.pth"])
def test_an_emptied_part_of_a_checkpoint_is_one_line(run: Path, part: str) -> None:
    file = run / STEP
    with ZipFile(file / "model.zip") as whole:
        parts = {name: whole.read(name) for name in whole.namelist()}
    with ZipFile(file / "model.zip", "w") as damaged:
        for name, content in parts.items():
            damaged.writestr(name, b"" if name == part else content)
    with pytest.raises(CheckpointError, match="move this checkpoint away to resume"):
        resumed(run)
    shutil.rmtree(file)
    shutil.rmtree(run / "best-000064", ignore_errors=True)
    assert resumed(run).ended == "finished"  # from the checkpoint at the start


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Callable[[str], None]]:
    """Mount a small disk at this folder; yield a function that enlarges it."""
    if os.geteuid() != 0:
        pytest.skip("only root can mount")
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        pytest.skip("nothing can be mounted here")

    def enlarge(size: str) -> None:
        subprocess.run(["mount", "-o", f"remount,size={size}", str(folder)], check=True)

    try:
        yield enlarge
    finally:
        subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_loses_nothing_and_advises_how_to_resume(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", "600k") as enlarge:
        job = brief_job(
            tmp_path / "disk" / "run",
            steps=100_000,
            checkpoint_every=64,
            evaluation=EvaluationSettings(every=0),
        )
        with pytest.raises(CheckpointError) as caught:
            train(job)
        assert "No space left on device; when that is mended, go on from the" in str(caught.value)
        assert str(caught.value).endswith(f" --resume {job.folder}")
        enlarge("50m")
        before = checkpoints.read_state(checkpoints.newest(job.folder)).steps
        more = replace(job.settings, steps=before + 64)
        assert train(replace(job, resume=True, settings=more)).ended == "finished"
        steps = [int(row["steps"]) for row in rows(job.folder / "progress.csv")]
        assert steps == list(range(64, before + 65, 64))


@pytest.mark.parametrize("size", ["16k", "32k", "48k"])
def test_a_full_disk_before_a_checkpoint_advises_to_restart(tmp_path: Path, size: str) -> None:
    with small_disk(tmp_path / "disk", size) as enlarge:
        job = brief_job(tmp_path / "disk" / "run", steps=64)
        with pytest.raises(CheckpointError) as caught:
            train(job)
        assert str(caught.value).endswith(
            f"No space left on device; when that is mended, remove {job.folder}, which has no "
            f"checkpoint yet, and start again with 'fishctl learn ppo --folder {job.folder}' and "
            "your other options"
        )
        enlarge("50m")
        with pytest.raises(ConfigError, match="the folder is not empty"):
            train(job)
        with pytest.raises(CheckpointError, match="it contains no checkpoint: the"):
            train(replace(job, resume=True))
        shutil.rmtree(job.folder)
        assert train(job).ended == "finished"
