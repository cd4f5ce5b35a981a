"""Pictures of experiments: by the verb itself, or later by `fishctl plot`, from the files."""

from pathlib import Path

import pytest
from rigs.processes import fishctl, one_line

SIMULATED = ("--on", "simulation", "--for", "21")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the folder of an experiment to come."""
    return tmp_path / "run"


def test_a_measurement_is_drawn_later_as_at_its_end(tmp_path: Path, folder: Path) -> None:
    first, later = tmp_path / "first.png", tmp_path / "later.png"
    where = ("--folder", str(folder), "--plot", str(first))
    assert fishctl("measure", "swing", *SIMULATED, *where).returncode == 0
    done = fishctl("plot", str(folder), "--to", str(later))
    assert (done.returncode, done.stderr) == (0, "")
    assert later.read_bytes() == first.read_bytes()


def test_a_comparison_that_is_kept_has_a_picture(folder: Path) -> None:
    words = ("hold", "swing", "--on", "simulation", "--for", "15", "--settle", "5")
    assert fishctl("compare", *words, "--folder", str(folder)).returncode == 0
    assert (folder / "compare.png").read_bytes().startswith(b"\x89PNG")


def test_of_an_experiment_without_a_result_the_recording_is_drawn(folder: Path) -> None:
    fishctl("measure", "swing", *SIMULATED, "--folder", str(folder))
    (folder / "result.json").unlink()
    done = fishctl("plot", folder.name, "--folder", str(folder.parent))
    assert done.stdout == f"{folder / 'run.png'}\n"
    assert (folder / "run.png").read_bytes().startswith(b"\x89PNG")


def test_what_cannot_be_drawn_of_an_experiment_is_refused_in_one_line(folder: Path) -> None:
    fishctl("measure", "swing", *SIMULATED, "--folder", str(folder))
    assert "for a recording" in one_line(fishctl("plot", str(folder), "--from", "3"))
    next(folder.glob("*.mcap")).unlink()
    assert "it contains no recording" in one_line(fishctl("plot", str(folder)))
