"""The picture of `tools/bench learning`."""

from pathlib import Path

import pytest
from rigs.pictures import letters_of, texts_in_pictures


def test_learning_curves_name_their_goal_and_where_the_axis_begins(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="install the extra 'lab'")
    from bench.learning_curves import learning_curves

    curve = [([200, 400], [0.5, 0.98]), ([200, 400], [0.6, 0.99])]
    trainings = {f"training-{k}": curve for k in range(7)}
    with texts_in_pictures():
        learning_curves(tmp_path / "curves.svg", trainings, 0.97)
    letters = letters_of(tmp_path / "curves.svg")
    assert "97%" in letters
    assert "from60%up" in letters
    assert all(name in letters for name in trainings)
