"""The machine that is measured on: what it is, what it permits, and how to keep it busy."""

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
"""SCHED_FIFO priority of fishd and of what it is compared with."""


def machine() -> dict[str, str]:
    """What the numbers depend on."""
    cpuinfo = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    names = [line for line in cpuinfo.splitlines() if line.startswith(("model name", "Model"))]
    kernel = os.uname()
    virtual = "yes" if "hypervisor" in cpuinfo else "no hypervisor is visible"
    if shutil.which("systemd-detect-virt"):
        found = subprocess.run(["systemd-detect-virt"], stdout=subprocess.PIPE, text=True).stdout
        virtual += f"; systemd-detect-virt says {found.strip()}"
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


def machine_in_short() -> str:
    """The same as one sentence."""
    about = machine()
    cores, python, fifo = (about[key] for key in ("Cores", "Python", "SCHED_FIFO"))
    return f"{about['CPU']}, {cores} cores; Python {python}; SCHED_FIFO: {fifo}."


@cache
def fifo_permitted() -> bool:
    """May processes that this one starts ask for real-time scheduling?"""
    ask = f"import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({PRIORITY}))"
    return subprocess.run([sys.executable, "-c", ask], stderr=subprocess.DEVNULL).returncode == 0


def priorities(highest: int = PRIORITY) -> tuple[int, ...]:
    """Those to measure with: 0, the normal scheduler, and a real-time one where permitted."""
    return (0, highest) if fifo_permitted() else (0,)


def scheduling(priority: int) -> str:
    """A priority in words."""
    return f"SCHED_FIFO {priority}" if priority else "normal"


def load(stressed: bool) -> str:
    """A load in words."""
    return "under load" if stressed else "idle"


@contextmanager
def stress(wanted: bool, limit: float) -> Iterator[None]:
    """Keep every core busy; whatever happens to us, it ends after `limit` seconds."""
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
