"""A run folder through kills, full disks, damage and two trainings at once."""

import json
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest

pytest.importorskip("torch", reason="the extra 'learn' is not installed")
pytest.importorskip("stable_baselines3", reason="the extra 'learn' is not installed")
pytest.importorskip("tensorboard", reason="the extra 'learn' is not installed")

from msgspec.structs import replace
from swimming import brief_job, rows

from fishd.errors import ConfigError
from fishd.learning import checkpoints, runs
from fishd.learning.checkpoints import CheckpointError, Evaluation
from fishd.learning.progress import Quiet
from fishd.learning.settings import EvaluationSettings
from fishd.learning.training import train


def test_a_kill_between_table_and_checkpoint_leaves_no_gap(tmp_path: Path) -> None:
    """Wherever a run is cut off, its newest checkpoint is no newer than its tables."""
    job = brief_job(tmp_path / "run", steps=256)

    class Killed(Quiet):
        def evaluated(self, evaluation: Evaluation, best: bool) -> None:
            if evaluation.steps == 192:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(job, Killed())
    train(replace(job, resume=True))
    for name in ("progress.csv", "evaluations.csv"):
        assert [row["steps"] for row in rows(job.folder / name)] == ["64", "128", "192", "256"]


def test_a_run_in_progress_is_not_resumed_by_another(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run", steps=256)
    said = []

    def resume_too() -> bool:
        with pytest.raises(ConfigError, match=f"is being trained in, by process {os.getpid()}"):
            train(replace(job, resume=True))
        said.append(True)
        return True

    train(job, stop=resume_too)
    assert said
    assert train(replace(job, resume=True)).ended == "finished"
    assert not list(job.folder.glob("*.lock"))


@pytest.mark.parametrize("until", ["", "plant:", "ppo:"])
def test_a_file_of_a_run_that_was_cut_off_is_not_made_up_for_by_defaults(
    tmp_path: Path, until: str
) -> None:
    job = brief_job(tmp_path / "run", steps=64)
    train(job)
    file = job.folder / (runs.CONFIG if until == "plant:" else runs.SETTINGS)
    text = file.read_text(encoding="utf-8")
    file.write_text(text[: text.index(until)], encoding="utf-8")
    with pytest.raises(ConfigError, match=f"{file.name}: not the whole file of a run: [a-z_]+ is"):
        runs.read(job.folder)


def test_a_resume_with_another_fish_or_other_networks_is_refused(tmp_path: Path) -> None:
    job = brief_job(tmp_path / "run", steps=64)
    train(job)
    more = replace(job.settings, steps=128)
    wider = replace(job.config, amplitude_limit=0.3)
    relu = replace(more, ppo=replace(more.ppo, activation="relu"))
    blind = replace(more, environment=replace(more.environment, force_scale=2.0))
    for config, settings, message in (
        (wider, more, "its observation, with scales, differs"),
        (job.config, blind, "its observation, with scales, differs"),
        (job.config, relu, "its ppo.activation is tanh, that of this training is relu"),
    ):
        with pytest.raises(CheckpointError, match=message):
            train(replace(job, resume=True, config=config, settings=settings))
    assert train(replace(job, resume=True, settings=more)).ended == "finished"


@pytest.mark.parametrize("content", ["", "a,b\n1,2\n", "steps\nmany\n", "\xff\x00"])
def test_a_table_that_is_none_is_one_line_and_can_be_moved_away(
    tmp_path: Path, content: str
) -> None:
    job = brief_job(tmp_path / "run", steps=64)
    train(job)
    more = replace(job, resume=True, settings=replace(job.settings, steps=128))
    table = job.folder / "progress.csv"
    table.write_bytes(content.encode("latin-1"))
    with pytest.raises(CheckpointError, match="no table of a training; move it away"):
        train(more)
    table.unlink()
    assert train(more).ended == "finished"


@pytest.mark.parametrize("part", ["policy.pth", "policy.optimizer.pth"])
def test_an_emptied_part_of_a_checkpoint_is_one_line(tmp_path: Path, part: str) -> None:
    job = brief_job(tmp_path / "run", steps=64)
    file = train(job).checkpoint
    assert file
    with ZipFile(file / "model.zip") as whole:
        parts = {name: whole.read(name) for name in whole.namelist()}
    with ZipFile(file / "model.zip", "w") as damaged:
        for name, content in parts.items():
            damaged.writestr(name, b"" if name == part else content)
    more = replace(job, resume=True, settings=replace(job.settings, steps=128))
    with pytest.raises(CheckpointError, match="move this checkpoint away to go on from the one"):
        train(more)
    shutil.rmtree(file)
    shutil.rmtree(job.folder / "best-000064", ignore_errors=True)
    assert train(more).ended == "finished"  # from the one at the start


@pytest.mark.parametrize("damage", [{}, {"torch": "00"}, {"numpy": []}, {"environment": 3}])
def test_a_damaged_state_of_random_numbers_is_one_line(
    tmp_path: Path, damage: dict[str, Any]
) -> None:
    job = brief_job(tmp_path / "run", steps=64)
    checkpoint = train(job).checkpoint
    assert checkpoint
    state = json.loads((checkpoint / "state.json").read_text(encoding="utf-8"))
    state["random"] = (state["random"] | damage) if damage else {}
    (checkpoint / "state.json").write_text(json.dumps(state), encoding="utf-8")
    with pytest.raises(CheckpointError, match="not the state of random numbers"):
        train(replace(job, resume=True, settings=replace(job.settings, steps=128)))


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Callable[[str], None]]:
    """A disk of its own in this folder; what it yields makes it larger."""
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


def test_a_full_disk_loses_nothing_and_says_how_to_go_on(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("size", ["16k", "28k", "48k"])
def test_a_disk_that_is_full_before_the_first_checkpoint_advises_to_start_again(
    tmp_path: Path, size: str
) -> None:
    with small_disk(tmp_path / "disk", size) as enlarge:
        job = brief_job(tmp_path / "disk" / "run", steps=64)
        with pytest.raises(CheckpointError) as caught:
            train(job)
        assert str(caught.value).endswith(
            f"No space left on device; when that is mended, remove {job.folder}, which has no "
            f"checkpoint yet, and start again with 'fishctl learn ppo --folder {job.folder}' and "
            "what else you gave"
        )
        enlarge("50m")
        with pytest.raises(ConfigError, match="or remove it: the training in it ended before its"):
            train(job)
        with pytest.raises(CheckpointError, match="no checkpoint is in there: its training ended"):
            train(replace(job, resume=True))
        shutil.rmtree(job.folder)
        assert train(job).ended == "finished"
