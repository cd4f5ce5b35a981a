"""Root folder of a small Debian with fishd's checkout and its wheels, ready to boot."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from common.report import progress

CHECKOUT = Path(__file__).resolve().parents[3]
_SUITES = {(3, 11): "bookworm", (3, 13): "trixie"}
"""Debian's release with the same Python as this one, so that binary wheels are compatible."""
_TOOLS = {"debootstrap": "debootstrap", "systemd-nspawn": "systemd-container", "git": "git"}
_PACKAGES = "systemd,systemd-sysv,dbus,make,python3,python3-venv,udev"


def check_machine(base: Path | None) -> None:
    """Raise SystemExit when a root folder cannot be made or booted here.

    base: as for `build`; the tools that make it are not required where it exists
    """
    if os.geteuid() != 0:
        raise SystemExit("to boot a root folder needs root: sudo make trial-systemd")
    has_base = base is not None and base.exists()
    for tool, package in _TOOLS.items():
        if tool == "debootstrap" and has_base:
            continue
        if shutil.which(tool) is None:
            raise SystemExit(f"{tool} is missing: sudo apt install {package}")
    if sys.version_info[:2] not in _SUITES:
        raise SystemExit(
            "run this with Python 3.11 or 3.13: a release of Debian must have the same"
        )


def build(work: Path, base: Path | None) -> Path:
    """Make the folder `work`/root and return it.

    base: folder that keeps the bare Debian between trials; made when it does not exist
    """
    root = make_debian(work, base)
    checkout = root / "root" / "fishd"
    checkout.mkdir()
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
        cwd=CHECKOUT,
        capture_output=True,
        check=True,
    ).stdout.decode()
    for name in filter(None, listed.split("\0")):
        if (CHECKOUT / name).is_file():
            (checkout / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(CHECKOUT / name, checkout / name)
    _wheels(root / "root" / "wheels")
    return root


def make_debian(work: Path, base: Path | None) -> Path:
    """Make the bare Debian of `build`, and return its folder."""
    root = work / "root"
    if base is None:
        _debootstrap(root)
    else:
        if not base.exists():
            _debootstrap(base)
        subprocess.run(["cp", "--archive", base, root], check=True)
    return root


def _debootstrap(folder: Path) -> None:
    suite = _SUITES[sys.version_info[:2]]
    progress(f"making a Debian {suite}; takes a minute")
    subprocess.run(
        ["debootstrap", "--variant=minbase", f"--include={_PACKAGES}", suite, folder],
        stdout=subprocess.DEVNULL,
        check=True,
    )


def _wheels(folder: Path) -> None:
    """Collect all wheels of the installation, which runs without a network."""
    progress("collecting wheels")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    wanted = [f"{CHECKOUT}[{core_extras()}]", "hatchling", "hatch-vcs"]
    subprocess.run([*pip, "wheel", "--wheel-dir", folder, *wanted], check=True)
    for own in folder.glob("fishd-*.whl"):
        own.unlink()  # the installation builds this wheel itself


def core_extras() -> str:
    """Return the extras that the installation installs, read from its script."""
    script = 'source "$0/tools/install_pi.sh"; core_extras $(about_python "$1")'
    command = ["bash", "-c", script, str(CHECKOUT), sys.executable]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
