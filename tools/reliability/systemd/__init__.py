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

from common.report import BrokenPromise, Options, Report, progress, table
from reliability.systemd.container import Container, wait_for
from reliability.systemd.root import build, check_machine
from reliability.systemd.trials import CONFIG, TRIALS, Rig, Row

HERE = Path(__file__).resolve().parent
UNIT = "etc/systemd/system/fishd.service"
SOCKET = "/run/fishd-virtual-pi/socket"
_MAY = "CAP_SYS_NICE CAP_IPC_LOCK"


OPTIONS: Options = {
    "--base": {"type": Path, "help": "folder that keeps the bare Debian for next time"},
    "--keep": {"action": "store_true", "help": "keep the root folder and say where"},
}


def measure(options: Namespace) -> Report:
    """Run every trial; raises `BrokenPromise`, and SystemExit where trials are not possible."""
    check_machine(options.base)
    with work_folder(options.keep) as work, Container(build(work, options.base)) as container:
        return _try_all(container)


def _try_all(container: Container) -> Report:
    limits = _may_raise_limits()
    _install(container)
    _configure(container, limits)
    pulses = container.root.parent / "pulses.log"
    with _watching(container, pulses):
        rows = []
        for trial in TRIALS:
            rig = Rig(container, pulses)
            rig.swim()
            rows.append(trial(rig))
            progress(rows[-1].what, rows[-1].outcome)
    _uninstall(container)
    return Report({"reliability systemd": _text(container, rows, limits)}, rows)


def _install(container: Container) -> None:
    """Install fishd as on a Pi, without a network."""
    progress("installing fishd")
    pip = ["PIP_NO_INDEX=1", "PIP_FIND_LINKS=/root/wheels", "FISHD_GPIO=none"]
    for _ in range(2):  # the second run finds everything installed
        container.run("env", *pip, "make", "-C", "/root/fishd", "install-pi")


def _uninstall(container: Container) -> None:
    """Uninstall fishd, which stops a swimming fish and keeps the edited configuration."""
    container.run("systemctl", "start", "fishd")
    container.run("make", "-C", "/root/fishd", "uninstall-pi")
    left = [path for path in ("opt/fishd", UNIT) if (container.root / path).exists()]
    if left or container.show("fishd.service", "ActiveState") != "inactive":
        raise BrokenPromise(f"uninstalling leaves {', '.join(left) or 'the daemon running'}")
    if not (container.root / CONFIG).exists():
        raise BrokenPromise("uninstalling takes away an edited configuration")
    progress("uninstalled")


def _configure(container: Container, limits: bool) -> None:
    virtual_pi = (container.root / "root/fishd/config/virtual-pi.yaml").read_text()
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
    python = ["/opt/fishd/bin/python", "/root/watch_pulses.py", SOCKET]
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


def _text(container: Container, rows: list[Row], limits: bool) -> str:
    version = container.run("systemctl", "--version").split()[1]
    python = container.run("python3", "--version")
    cells = (
        (row.what, *("" if t is None else f"{t:.2f}" for t in row[1:4]), row.outcome)
        for row in rows
    )
    text = (
        f"systemd {version}, {python}, fishd from `make install-pi` with "
        "the virtual Pi; times in seconds from the action.\n\n"
        + table("action | servo neutral | pulses off | ready (again) | outcome", cells)
    )
    if not limits:
        text += (
            f"\n\nThis machine forbids systemd to raise limits; {_MAY} replaced `LimitRTPRIO=` "
            "and `LimitMEMLOCK=`. The unit is otherwise as installed."
        )
    return text
