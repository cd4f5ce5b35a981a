"""Trials of an installed fishd under a real systemd in a container: starts, stops, hangs and kills.

Needs root, a network and Debian's packages debootstrap and systemd-container; some minutes.
"""

import resource
import shutil
import subprocess
import tempfile
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from common.report import Report, progress, table
from reliability.systemd.container import Container, wait_for
from reliability.systemd.root import (
    CHECKOUT,
    HOME,
    OPTIONS,
    build_package,
    check_machine,
    make_debian,
)
from reliability.systemd.trials import CONFIG, TRIALS, Rig

__all__ = ["OPTIONS", "measure"]
HERE = Path(__file__).resolve().parent
SUITE = "bookworm"
"""Release of Debian with the systemd of a Raspberry Pi OS 12."""
SOCKET = "/run/fishd-virtual-pi/socket"
_MAY = "CAP_SYS_NICE CAP_IPC_LOCK"


def measure(options: Namespace) -> Report:
    """Run every trial; raises `BrokenPromise`, and SystemExit where trials are not possible."""
    check_machine()
    with work_folder(options.keep) as work:
        root = make_debian(work, SUITE, options)
        shutil.copy(build_package(work, SUITE), root / "root" / "fishd.deb")
        with Container(root) as container:
            return _try_all(container)


def _try_all(container: Container) -> Report:
    limits = _may_raise_limits()
    container.run("dpkg", "--install", "/root/fishd.deb")
    _configure(container, limits)
    pulses = container.root.parent / "pulses.log"
    with _watching(container, pulses):
        rows = []
        for trial in TRIALS:
            rig = Rig(container, pulses)
            rig.swim()
            rows.append(trial(rig))
            progress(rows[-1].what, rows[-1].outcome)
    cells = ((r.what, *("" if t is None else f"{t:.2f}" for t in r[1:4]), r.outcome) for r in rows)
    head = "action | servo neutral [s] | pulses off [s] | ready (again) [s] | outcome"
    offs = [row.off for row in rows if row.off is not None]
    number = f"{len(rows)} actions as promised; pulses off after at most {max(offs):.2f} s"
    return Report({"reliability systemd": table(head, cells)}, rows, number=number)


def _configure(container: Container, limits: bool) -> None:
    virtual_pi = (CHECKOUT / "config/virtual-pi.yaml").read_text()
    virtual_pi = virtual_pi.replace("virtual_pi:\n", f"virtual_pi:\n  socket: {SOCKET}\n")
    (container.root / CONFIG).write_text(f"{virtual_pi}\nstate_folder: /var/lib/fishd\n")
    units = container.root / "etc/systemd/system"
    shutil.copy(HERE / "fishd-virtual-pi.service", units)
    shutil.copy(HERE / "watch_pulses.py", container.root / "root")
    if not limits:
        (units / "fishd.service.d").mkdir()
        (units / "fishd.service.d/trial.conf").write_text(
            f"[Service]\nCapabilityBoundingSet={_MAY}\nAmbientCapabilities={_MAY}\n"
        )
    container.run("systemctl", "daemon-reload")
    container.run("systemctl", "start", "fishd-virtual-pi")


def _may_raise_limits() -> bool:
    """Return whether systemd in the container can grant LimitRTPRIO, which some machines forbid."""
    try:
        resource.setrlimit(resource.RLIMIT_RTPRIO, (50, 50))
    except (OSError, ValueError):
        return False
    return True


@contextmanager
def _watching(container: Container, pulses: Path) -> Iterator[None]:
    python = [f"/{HOME}/bin/python", "/root/watch_pulses.py", SOCKET]
    wait_for(
        lambda: bool(container.run("sh", "-c", f"test -S {SOCKET} && echo yes", check=False)),
        "the virtual Pi does not start",
    )
    with pulses.open("wb") as log:
        watcher = subprocess.Popen(container.command(*python), stdout=log)
    try:
        wait_for(lambda: pulses.stat().st_size > 0, "the pulses cannot be watched")
        yield
    finally:
        watcher.terminate()
        watcher.wait()


@contextmanager
def work_folder(keep: bool) -> Iterator[Path]:
    """Make a folder for the context, and remove it afterwards unless it is to be kept."""
    folder = Path(tempfile.mkdtemp(prefix="fishd-systemd-trial-"))
    try:
        yield folder
    finally:
        if keep:
            progress(f"kept: {folder}")
        else:
            shutil.rmtree(folder)
