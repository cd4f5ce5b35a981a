"""A few of the kills that docs/reliability.md counts by the thousand."""

import subprocess
import sys
from pathlib import Path

import msgspec

TOOL = Path(__file__).parents[2] / "tools" / "random_kills.py"


def test_a_fishd_that_is_killed_at_any_moment_leaves_no_pulses() -> None:
    command = ["--kills", "30", "--lanes", "3", "--seed", "4", "--limit", "60", "--json"]
    run = subprocess.run(
        [sys.executable, str(TOOL), *command],
        capture_output=True,
        text=True,
        check=False,
        timeout=240,
    )
    kills = [msgspec.json.decode(line) for line in run.stdout.splitlines()]
    assert [kill for kill in kills if kill["off"] is None] == []
    assert run.returncode == 0, run.stderr
    assert len(kills) >= 10
    assert any(kill["swimming"] for kill in kills)
    assert any(kill["stopped"] for kill in kills)
