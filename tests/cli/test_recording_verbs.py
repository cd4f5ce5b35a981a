"""What the verbs about recordings refuse and say."""

from pathlib import Path

import pytest
from rigs.processes import fishctl, one_line


@pytest.mark.parametrize("length", ["nan", "inf", "-inf", "0"])
def test_a_recording_has_a_length_that_ends(tmp_path: Path, length: str) -> None:
    refused = fishctl("record", "--for", length, "--folder", str(tmp_path))
    assert refused.returncode == 2
    assert "'--for'" in one_line(refused)
    assert list(tmp_path.iterdir()) == []
