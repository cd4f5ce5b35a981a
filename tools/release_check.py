"""Runs every check of a release and prints one table; a failed one does not stop the others.

A check that this machine cannot run is neither passed nor failed: the table says why.

`make release-check` needs root and the tools that each check names. `--only NAME ...` runs some.
"""

import argparse
import re
import subprocess
import sys
import time
from pathlib import Path

from common.report import progress, table

ROOT = Path(__file__).resolve().parents[1]
LOGS = ROOT / "build" / "release-check"
PYTEST = [sys.executable, "-m", "pytest"]
CHECKS: dict[str, list[str]] = {
    "lint": ["make", "lint"],
    "docs": ["make", "docs"],
    "docs links": [*PYTEST, "tests/unit/docs"],
    "examples": [*PYTEST, "tests/system/docs", "tests/system/test_docs_examples.py"],
    "tests": ["make", "test"],
    "real-time tests": ["make", "test-realtime"],
    "packages": ["make", "packages"],
    "Debian package": ["make", "deb"],
    "trial of the Debian package": ["make", "trial-deb"],
    "container": ["tools/try_container.sh"],
    "systemd trial": ["make", "trial-systemd"],
    "arm64 trial": ["make", "trial-arm64"],
}
"""Command of each check, by its name in the table."""
REFUSAL = re.compile(r"^(?:\w+: )?(not run here: .+)$", re.MULTILINE)
"""Line by which a check says that this machine cannot run it, and why."""


def run(name: str, command: list[str]) -> tuple[str, str, str]:
    """Run a check; return its row: name, seconds and result."""
    log = LOGS / f"{name.replace(' ', '-')}.log"
    started = time.monotonic()
    with log.open("wb") as file:
        code = subprocess.run(
            command, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT, check=False
        ).returncode
    result = f"FAILED with exit status {code}: {log.relative_to(ROOT)}" if code else "passed"
    if code and (refusals := REFUSAL.findall(log.read_text(errors="replace"))):
        result = refusals[-1]
    progress(name, result)
    return name, f"{time.monotonic() - started:.0f}", result


def main() -> None:
    """Run the checks of the command line; exit with 1 if one has failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=CHECKS, default=[*CHECKS], metavar="NAME")
    LOGS.mkdir(parents=True, exist_ok=True)
    rows = [run(name, CHECKS[name]) for name in parser.parse_args().only]
    print(table("check | seconds | result", rows))
    sys.exit(any(result != "passed" for *_, result in rows))


if __name__ == "__main__":
    main()
