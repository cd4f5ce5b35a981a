"""A short run of each soak; docs/reliability.md has the figures of long ones."""

import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).parents[1] / "tools" / "soak.py"


@pytest.mark.parametrize(
    ("arguments", "promise"),
    [
        (["simulated", "--ticks", "20000"], "no exception, every angle within limits"),
        (["virtual-pi", "--ticks", "800"], "no exception, every angle within limits"),
        (["channels", "--reads", "10000"], "no value of the wrong channel"),
    ],
)
def test_a_soak_keeps_its_promises(arguments: list[str], promise: str) -> None:
    run = subprocess.run(
        [sys.executable, str(TOOL), *arguments],
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )
    assert run.returncode == 0, run.stderr
    assert promise in run.stdout
    assert run.stderr == ""


def test_a_broken_promise_is_noticed(tmp_path: Path) -> None:
    """The same soak on a guard that lets everything through."""
    sabotage = (
        f"import sys; sys.path.insert(0, {str(TOOL.parent)!r}); sys.argv[1:] = "
        "['simulated', '--ticks', '20000']\n"
        "from fishd.guard import Guard\n"
        "Guard.apply = lambda self, command, previous: float(command)\n"
        "import soak; sys.exit(soak.main())"
    )
    run = subprocess.run(
        [sys.executable, "-c", sabotage], capture_output=True, text=True, check=False, timeout=200
    )
    assert run.returncode == 1
    assert "BROKEN" in run.stderr
