"""Boots a real systemd in a container, installs fishd there, and starts, stops, hangs and kills it.

sudo .venv/bin/python tools/systemd_trial                              print the table
sudo .venv/bin/python tools/systemd_trial --write docs/reliability.md  put it there
"""

import argparse
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from container import Broken, Container, wait_for
from root import CannotTry, build, check_machine
from trials import CONFIG, TRIALS, Rig, Row

BEGIN, END = "<!-- systemd trial: begin -->", "<!-- systemd trial: end -->"
HERE = Path(__file__).resolve().parent
UNIT = "etc/systemd/system/fishd.service"
SOCKET = "/run/fishd-virtual-pi/socket"
_MAY = "CAP_SYS_NICE CAP_IPC_LOCK"


def main() -> int:
    """Parse the command line, try, report."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--base", type=Path, help="folder that keeps the bare Debian for next time")
    parser.add_argument("--keep", action="store_true", help="keep the root folder and say where")
    parser.add_argument("--write", type=Path, metavar="FILE", help="replace the table in FILE")
    options = parser.parse_args()
    if options.write:
        _write(options.write, None)  # to learn now, not in minutes, that it cannot be written
    try:
        check_machine()
        with _work_folder(options.keep) as work, Container(build(work, options.base)) as container:
            report = _try_all(container)
    except (Broken, CannotTry) as error:
        print(f"systemd_trial: {error}", file=sys.stderr)
        return 1
    if options.write:
        _write(options.write, report)
    print(report)
    return 0


def _try_all(container: Container) -> str:
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
            print(f"{rows[-1].what}: {rows[-1].outcome}", file=sys.stderr, flush=True)
    _uninstall(container)
    return _table(container, rows, limits)


def _install(container: Container) -> None:
    """As on a Pi, but for the network."""
    print("installing fishd", file=sys.stderr, flush=True)
    pip = ["PIP_NO_INDEX=1", "PIP_FIND_LINKS=/root/wheels", "FISHD_GPIO=none"]
    for _ in range(2):  # the second time, everything is there already
        container.run("env", *pip, "make", "-C", "/root/fishd", "install-pi")


def _uninstall(container: Container) -> None:
    """It stops a fish that swims, and leaves the configuration, which was edited."""
    container.run("systemctl", "start", "fishd")
    container.run("make", "-C", "/root/fishd", "uninstall-pi")
    left = [path for path in ("opt/fishd", UNIT) if (container.root / path).exists()]
    if left or container.show("fishd.service", "ActiveState") != "inactive":
        raise Broken(f"uninstalling leaves {', '.join(left) or 'the daemon running'}")
    if not (container.root / CONFIG).exists():
        raise Broken("uninstalling takes away an edited configuration")
    print("uninstalled", file=sys.stderr, flush=True)


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
    """Whether systemd in the container will be able to grant LimitRTPRIO; some machines forbid."""
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
def _work_folder(keep: bool) -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="fishd-systemd-trial-"))
    try:
        yield folder
    finally:
        if keep:
            print(f"kept: {folder}", file=sys.stderr)
        else:
            shutil.rmtree(folder)


def _table(container: Container, rows: list[Row], limits: bool) -> str:
    version = container.run("systemctl", "--version").split()[1]
    lines = [
        f"systemd {version}, Python {platform.python_version()}, fishd from `make install-pi` with "
        "the virtual Pi; times in seconds from what was done to the daemon.",
        "",
        "| what | servo neutral | pulses off | ready (again) | outcome |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        times = (f"{t:.2f}" if t is not None else "" for t in (row.neutral, row.off, row.again))
        lines.append(f"| {row.what} | {' | '.join(times)} | {row.outcome} |")
    if not limits:
        lines += [
            "",
            f"This machine forbids systemd to raise limits; {_MAY} stood in for `LimitRTPRIO=` "
            "and `LimitMEMLOCK=`. All else is the unit as installed.",
        ]
    return "\n".join(lines)


def _write(path: Path, report: str | None) -> None:
    """Replace what is between the markers; None only checks that they are there."""
    text = path.read_text(encoding="utf-8") if path.is_file() else ""
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise SystemExit(f"systemd_trial: {path}: the markers {BEGIN} and {END} are needed")
    if report is not None:
        path.write_text(f"{before}{BEGIN}\n\n{report}\n\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
