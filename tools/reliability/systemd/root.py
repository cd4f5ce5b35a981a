"""Root folder of a small Debian, ready to boot, and the Debian package of fishd for it."""

import os
import shutil
import subprocess
import sys
from argparse import Namespace
from pathlib import Path

from common.report import Options, progress

CHECKOUT = Path(__file__).resolve().parents[3]
HOME = "usr/lib/fishd"
"""Folder of the installed fishd."""
PYTHONS = {"bookworm": "3.11", "trixie": "3.13"}
"""Version of Python in a release of Debian."""
_TOOLS = {"debootstrap": "debootstrap", "systemd-nspawn": "systemd-container"}
_PACKAGES = "systemd,systemd-sysv,dbus,python3,udev"
OPTIONS: Options = {
    "--base": {"type": Path, "help": "folder that keeps the bare Debians for next time"},
    "--keep": {"action": "store_true", "help": "keep the root folder and say where"},
}


def check_machine() -> None:
    """Raise SystemExit when a root folder cannot be made or booted here."""
    if os.geteuid() != 0:
        raise SystemExit("not run here: to boot a root folder needs root; use sudo")
    for tool, package in _TOOLS.items():
        if shutil.which(tool) is None:
            raise SystemExit(f"not run here: {tool} is missing: sudo apt install {package}")


def make_debian(work: Path, suite: str, options: Namespace) -> Path:
    """Make the folder `work`/root with a bare Debian, and return it."""
    root = work / "root"
    if options.base is None:
        _debootstrap(suite, root)
    else:
        base = options.base / suite
        if not base.exists():
            _debootstrap(suite, base)
        subprocess.run(["cp", "--archive", base, root], check=True)
    return root


def _debootstrap(suite: str, folder: Path) -> None:
    progress(f"making a Debian {suite}; takes a minute")
    folder.parent.mkdir(parents=True, exist_ok=True)
    subprocess.run(
        ["debootstrap", "--variant=minbase", f"--include={_PACKAGES}", suite, folder],
        stdout=subprocess.DEVNULL,
        check=True,
    )


def build_package(work: Path, suite: str) -> Path:
    """Build the Debian package of the checkout for a release of Debian, and return its file."""
    progress(f"building the package for {suite}")
    command = [sys.executable, CHECKOUT / "tools/deb", "--fast", "--python", PYTHONS[suite]]
    subprocess.run([*command, "--to", work], check=True)
    return next(work.glob("*.deb"))
