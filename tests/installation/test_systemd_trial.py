"""The trial under a real systemd, as far as it can be tried without one: what it takes inside."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from reliability.systemd import root

CHECKOUT = Path(__file__).resolve().parents[2]


def test_the_trial_collects_what_the_installation_inside_will_ask_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is no network inside."""
    collected: list[str] = []
    run = subprocess.run

    def record(command: list[Any], **options: Any) -> Any:
        if "wheel" not in command:
            return run(command, check=options.pop("check"), **options)
        collected.extend(map(str, command))
        return None

    monkeypatch.setattr(root.subprocess, "run", record)
    root._wheels(tmp_path)
    script = f'source {CHECKOUT}/tools/install_pi.sh; core_extras $(about_python "$0")'
    asked = subprocess.check_output(["bash", "-c", script, sys.executable], text=True).strip()
    assert asked == "pi,record,policy"
    assert f"{CHECKOUT}[{asked}]" in collected
