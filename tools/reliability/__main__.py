"""Trials that fishd must survive: `python tools/reliability NAME [OPTIONS]`."""

import sys
from pathlib import Path

sys.path[0] = str(Path(__file__).resolve().parents[1])  # tools/

from common.report import run  # noqa: E402

NAMES = ("deaths", "deb", "kills", "misbehaviour", "soak", "systemd")

if __name__ == "__main__":
    sys.exit(run("reliability", NAMES))
