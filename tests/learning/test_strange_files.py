"""A run folder in which something else has the name of a file."""

import json
import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile

import pytest

pytest.importorskip("torch", reason="the extra 'learn' is not installed")
pytest.importorskip("stable_baselines3", reason="the extra 'learn' is not installed")
pytest.importorskip("tensorboard", reason="the extra 'learn' is not installed")

from msgspec.structs import replace
from swimming import brief_job

from fishd.errors import FishdError
from fishd.learning import checkpoints, runs
from fishd.learning import settings as training
from fishd.learning.checkpoints import CheckpointError
from fishd.learning.seed_table import curve
from fishd.learning.tables import Table
from fishd.learning.training import train

PATIENCE = 60.0
STEP = "step-000064"


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole run."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    train(brief_job(folder, steps=64))
    return folder


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """A copy of it, to be damaged."""
    return Path(shutil.copytree(finished, tmp_path / "run"))


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
    "evaluations.csv": curve,
}


def complaint(read: Callable[[Path], object], run: Path) -> str:
    """What is said, in time."""
    found: list[str] = []

    def try_it() -> None:
        try:
            read(run)
        except FishdError as error:
            found.append(str(error))

    reader = threading.Thread(target=try_it, daemon=True)
    reader.start()
    reader.join(PATIENCE)
    assert found, "it does not end, or accepts it"
    assert "\n" not in found[0]
    return found[0]


@pytest.mark.parametrize("plant", [pipe, endless])
@pytest.mark.parametrize("name", READERS)
def test_a_pipe_or_a_device_in_place_of_a_file_is_one_line_at_once(
    run: Path, name: str, plant: Callable[[Path], None]
) -> None:
    (run / name).unlink()
    plant(run / name)
    said = complaint(READERS[name], run)
    if name == "progress.csv":  # whatever it is, a new one can be begun
        assert "no table of a training; move it away" in said
    else:
        kind = "a named pipe" if plant is pipe else "a device"
        assert said.startswith(f"{run / name}: is {kind}; a regular file is needed")


@pytest.mark.parametrize("name", ["state.json", "card.json"])
def test_json_without_an_end_to_its_depth_is_one_line(run: Path, name: str) -> None:
    reader = READERS[f"{STEP}/{name}"]
    for depth in (60, 900, 9000):
        (run / STEP / name).write_text('{"on":' * depth + "1" + "}" * depth, encoding="utf-8")
        assert "nested too deeply" in complaint(reader, run)


def test_a_state_that_is_deep_in_one_place_is_one_line(run: Path) -> None:
    state = json.loads((run / STEP / "state.json").read_text(encoding="utf-8"))
    deep: list[object] = []
    for _ in range(100):
        deep = [deep]
    state["random"]["torch"] = deep
    (run / STEP / "state.json").write_text(json.dumps(state), encoding="utf-8")
    assert "nested too deeply; move this checkpoint away" in complaint(
        READERS[f"{STEP}/state.json"], run
    )


def test_an_archive_that_would_fill_the_memory_is_refused(run: Path) -> None:
    with ZipFile(run / STEP / "model.zip", "w", ZIP_DEFLATED) as archive:
        for number in range(5):
            archive.writestr(f"{number}.pth", bytes(64 * 2**20))
    assert "it unpacks to far more than a checkpoint needs" in complaint(
        READERS[f"{STEP}/model.zip"], run
    )


def test_a_checkpoint_with_a_strange_number_is_not_the_newest(run: Path) -> None:
    (run / "step-²").mkdir()
    assert checkpoints.newest(run).name == STEP


def test_a_table_of_another_kind_is_one_line(run: Path) -> None:
    (run / "evaluations.csv").write_text("a,b\n1,2\n", encoding="utf-8")
    assert complaint(curve, run) == f"{run / 'evaluations.csv'}: no table of a training"


def test_a_resume_with_a_pipe_for_a_state_says_what_to_do(run: Path) -> None:
    (run / STEP / "state.json").unlink()
    pipe(run / STEP / "state.json")
    job = brief_job(run, steps=128)
    with pytest.raises(CheckpointError, match=r"is a named pipe; .* move this checkpoint away"):
        train(replace(job, resume=True))
