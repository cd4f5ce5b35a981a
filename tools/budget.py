"""Counts what a tick and a start-up cost, in numbers that do not depend on the machine.

python tools/budget.py            prints them beside the committed ones
python tools/budget.py --write    writes tests/budget.json; the commit says why one of them grew

tests/test_budget.py compares them. A tick is counted in calls of Python functions, a start-up in
fishd's own modules, the bytes of their source, and the other packages that it loads.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FILE = ROOT / "tests" / "budget.json"
ROOM = 0.05
"""Fraction by which a number may exceed the committed one."""
TICKS = {"simulated": 120, "virtual-pi": 36}
"""Number of ticks that are counted, by the robot, after as many that are not."""
POLICY = ROOT / "config" / "policies" / "default-fish.onnx"
CONTROLLERS: dict[str, dict[str, Any]] = {
    "swing": {},
    "square": {},
    "thrust": {"target": 0.015},
    "ppo": {"policy": str(POLICY)},
}

_REPORT = """
import json, os, sys
def report():
    names = sorted(name for name in sys.modules if name.partition(".")[0] == "fishd")
    files = [getattr(sys.modules[name], "__file__", None) for name in names]
    others = {name.partition(".")[0] for name in sys.modules} - set(sys.stdlib_module_names)
    others = sorted(name for name in others if not name.startswith("_") and name != "fishd")
    numbers = {"modules": len(names), "bytes": sum(os.path.getsize(file) for file in files if file)}
    with open(os.environ["BUDGET_FILE"], "w") as file:
        json.dump({**numbers, "packages": others}, file)
"""
_FISHCTL = """
leave = os._exit
def leave_with_report(code):
    report()
    leave(code)
os._exit = leave_with_report
try:
    from fishd.__main__ import fishctl
    fishctl()
finally:
    report()
"""
_FISHD = """
import signal
from fishd.__main__ import fishd
import fishd.daemon.main as daemon
ticked = daemon.Daemon._ticked
def first_tick(self, now):
    if not os.path.exists(os.environ["BUDGET_FILE"]):
        report()
        os.kill(os.getpid(), signal.SIGTERM)
    ticked(self, now)
daemon.Daemon._ticked = first_tick
fishd()
"""


def calls_per_tick(robot: str, controller: str) -> float:
    """Return the mean number of calls of Python functions in a tick of virtual time."""
    from fishd.config import load
    from fishd.lab.simulation import EncodingPublisher, VirtualRun

    calls, ticks = 0, TICKS[robot]

    def count(_: FrameType, event: str, __: object) -> None:
        nonlocal calls
        calls += event == "call"

    with VirtualRun(load(None, [f"robot={robot}"]), EncodingPublisher()) as run:
        run.set_controller(controller, CONTROLLERS[controller])
        for _ in range(ticks):
            run.tick()
        before = sys.getprofile()
        sys.setprofile(count)
        try:
            for _ in range(ticks):
                run.tick()
        finally:
            sys.setprofile(before)
    return round(calls / ticks, 1)


def start_up(command: str) -> dict[str, Any]:
    """Return what a command loads: `fishd` until its first tick, the others until they end."""
    with tempfile.TemporaryDirectory(prefix="fishd-") as folder:
        control = f"ipc://{folder}/control"
        environment = {**os.environ, "BUDGET_FILE": f"{folder}/budget", "PYTHONPATH": str(ROOT)}
        script, arguments = _FISHCTL, ["status", "--endpoint", control]
        if command == "completion":
            environment |= {
                "_FISHCTL_COMPLETE": "bash_complete",
                "COMP_WORDS": "fishctl\nset-controller\nsw",
                "COMP_CWORD": "2",
            }
            arguments = []
        if command == "fishd":
            settings = {
                "control.address": control,
                "telemetry.address": f"ipc://{folder}/telemetry",
                "state_folder": f"{folder}/state",
            }
            script, arguments = _FISHD, ["--no-print-status"]
            for key, value in settings.items():
                arguments += ["--set", f"{key}={value}"]
        subprocess.run(
            [sys.executable, "-c", _REPORT + script, *arguments],
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            timeout=60,
            check=False,
        )
        numbers: dict[str, Any] = json.loads(Path(folder, "budget").read_text(encoding="utf-8"))
        return numbers


def measure() -> dict[str, Any]:
    """Return all numbers."""
    return {
        "python": "{}.{}".format(*sys.version_info),
        "calls_per_tick": {
            robot: {name: calls_per_tick(robot, name) for name in CONTROLLERS} for robot in TICKS
        },
        "start_up": {name: start_up(name) for name in ("fishd", "fishctl status", "completion")},
    }


def committed() -> dict[str, Any]:
    """Return the committed numbers."""
    numbers: dict[str, Any] = json.loads(FILE.read_text(encoding="utf-8"))
    return numbers


def main() -> None:
    """Print the numbers, or write them."""
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("--write", action="store_true", help=f"write {FILE.relative_to(ROOT)}")
    options = parser.parse_args()
    numbers = measure()
    if options.write:
        FILE.write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
        return
    print(json.dumps({"committed": committed(), "measured": numbers}, indent=1))


if __name__ == "__main__":
    main()
