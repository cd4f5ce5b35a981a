"""Runs of the real `fishctl doctor`, and their results."""

import json
import os
import subprocess
from pathlib import Path

from rigs.processes import FISHCTL, call, fishctl

Findings = dict[str, tuple[str, str]]


def doctor(
    folder: Path, *settings: str, under: tuple[str, ...] = (), **env: str
) -> tuple[int, Findings]:
    """Return the exit status, and level and message of each check; all problems have remedies."""
    verb = ("doctor", "--json", "--set", f"control.address=ipc://{folder}/control", *settings)
    apart = bool(under or env)
    ended = call(*under, FISHCTL, *verb, env=os.environ | env) if apart else fishctl(*verb)
    status, findings = read_findings(ended)
    assert not any("broke off" in message for _, message in findings.values())
    return status, findings


def read_findings(ended: "subprocess.CompletedProcess[str]") -> tuple[int, Findings]:
    """Return the exit status of `fishctl doctor --json`, and its findings."""
    assert ended.stderr == ""
    findings = json.loads(ended.stdout)
    assert all(bool(f["remedy"]) == (f["level"] in ("warning", "FAIL")) for f in findings)
    return ended.returncode, {f["check"]: (f["level"], f["message"]) for f in findings}


def free_telemetry() -> list[str]:
    return ["--set", "telemetry.address=tcp://127.0.0.1:0"]
