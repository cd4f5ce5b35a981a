import subprocess
import sys
from pathlib import Path

import pytest

WITHOUT = """
import sys
sys.modules.update(dict.fromkeys({missing!r}))
from fishd.cli.main import main
sys.argv = ["fishctl", *{arguments!r}]
main()
"""


def call(missing: list[str], *arguments: str) -> subprocess.CompletedProcess[str]:
    """fishctl where some packages cannot be imported."""
    return subprocess.run(
        [sys.executable, "-c", WITHOUT.format(missing=missing, arguments=list(arguments))],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )


@pytest.mark.parametrize("missing", [["torch"], ["torch", "gymnasium", "stable_baselines3"]])
def test_training_without_the_extra_names_it_in_one_line(
    tmp_path: Path, missing: list[str]
) -> None:
    found = call(missing, "learn", "ppo", "--folder", str(tmp_path / "run"))
    assert found.returncode == 1
    assert found.stderr.count("\n") == 1
    assert " is not installed; where the sources of fishd are: pip install " in found.stderr
    assert found.stderr.endswith(" --editable '.[learn]'\n")
    assert not (tmp_path / "run").exists()


def test_the_verbs_are_listed_without_it() -> None:
    found = call(["torch", "gymnasium", "stable_baselines3"], "learn", "ppo", "--help")
    assert found.returncode == 0
    assert "--resume" in found.stdout
