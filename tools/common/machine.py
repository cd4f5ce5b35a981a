"""Machine of a measurement: its description, its permissions, and load for it."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

PRIORITY = 50
"""SCHED_FIFO priority of fishd and of the programs compared with it."""


def machine() -> dict[str, str]:
    """Return the properties of the machine that affect measurements."""
    cpuinfo = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    names = [line for line in cpuinfo.splitlines() if line.startswith(("model name", "Model"))]
    kernel = os.uname()
    virtual = "yes" if "hypervisor" in cpuinfo else "no hypervisor is visible"
    if shutil.which("systemd-detect-virt"):
        virtualisation = subprocess.run(
            ["systemd-detect-virt"], stdout=subprocess.PIPE, text=True
        ).stdout
        virtual += f"; systemd-detect-virt says {virtualisation.strip()}"
    load = "one busy Python process per core, as stress-ng is not installed"
    if shutil.which("stress-ng"):
        load = "stress-ng: one cpu worker per core, one io, one vm"
    return {
        "CPU": names[0].partition(":")[2].strip() if names else kernel.machine,
        "Cores": str(os.cpu_count()),
        "Kernel": f"{kernel.sysname} {kernel.release} {kernel.version}",
        "Virtual machine": virtual,
        "Python": sys.version.partition(" ")[0],
        "Load": load,
        "cyclictest": "installed" if shutil.which("cyclictest") else "left out, not installed",
        "SCHED_FIFO": f"priority {PRIORITY}" if fifo_permitted() else "left out, not permitted",
    }


@cache
def fifo_permitted() -> bool:
    """Return whether child processes may use real-time scheduling."""
    ask = f"import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({PRIORITY}))"
    return subprocess.run([sys.executable, "-c", ask], stderr=subprocess.DEVNULL).returncode == 0


def priorities(highest: int = PRIORITY) -> tuple[int, ...]:
    """Return the priorities to measure: 0 (normal), and a real-time one if permitted."""
    return (0, highest) if fifo_permitted() else (0,)


def scheduling(priority: int) -> str:
    """Return a description of a priority."""
    return f"SCHED_FIFO {priority}" if priority else "normal"


def load(stressed: bool) -> str:
    """Return a description of a load."""
    return "under load" if stressed else "idle"


@contextmanager
def stress(wanted: bool, limit: float) -> Iterator[None]:
    """Keep every core busy; the load ends after `limit` seconds even if this process dies."""
    cores = os.cpu_count() or 1
    commands: list[list[str]] = []
    if wanted and shutil.which("stress-ng"):
        words = ["--cpu", str(cores), "--io", "1", "--vm", "1", "--vm-bytes", "128M"]
        commands = [["stress-ng", "--quiet", *words, "--timeout", f"{limit:.0f}s"]]
    elif wanted:
        spin = f"import time; end = time.monotonic() + {limit}\nwhile time.monotonic() < end: pass"
        commands = [[sys.executable, "-c", spin]] * cores
    processes = [subprocess.Popen(command) for command in commands]
    try:
        time.sleep(1.0 if wanted else 0.0)
        yield
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait()
