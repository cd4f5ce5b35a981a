"""tools/install_pi.sh on a folder like the disk of a Pi: which package, bus and pigpiod it sets up.

Programs that would change this machine are replaced by one that logs its command line.
`make trial-deb` runs the script with the true ones.
"""

import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from rigs.documents import ROOT
from rigs.processes import call

BAUDRATE = "dtparam=i2c_arm_baudrate=400000"
POLICY = "pigpio:\n  Installed: (none)\n  Candidate: 1.79-1\n"
STAND_IN = """#!/bin/sh
echo "${0##*/} $*" >>"$LOG"
case "${0##*/} $*" in
  "dpkg --print-architecture") echo "$MACHINE" ;;
  "apt-cache policy pigpio") printf '%s' "$POLICY" ;;
  "systemctl --quiet is-active pigpiod") exit 3 ;;
esac
"""


class Pi:
    """Checkout with packages in dist/, and a folder that replaces the disk of a Pi."""

    def __init__(self, folder: Path) -> None:
        self.dist, self.log, self.disk = folder / "dist", folder / "log", folder / "disk"
        self.config = self.disk / "boot/firmware/config.txt"
        for path in (folder / "tools", folder / "bin", self.dist, self.config.parent):
            path.mkdir(parents=True)
        shutil.copy(ROOT / "tools" / "install_pi.sh", folder / "tools")
        for name in ("dpkg", "apt-get", "apt-cache", "raspi-config", "systemctl"):
            (folder / "bin" / name).write_text(STAND_IN)
            (folder / "bin" / name).chmod(0o755)
        (self.disk / "etc").mkdir()
        self.set_debian("12")
        self.config.write_text("[cm5]\ndtoverlay=dwc2\n")

    def set_debian(self, release: str) -> None:
        (self.disk / "etc/os-release").write_text(f'ID=debian\nVERSION_ID="{release}"\n')

    def set_model(self, model: str) -> None:
        (self.disk / "proc/device-tree").mkdir(parents=True)
        (self.disk / "proc/device-tree/model").write_text(f"{model}\0")

    def add_package(self, version: str, suffix: str, age_s: float = 0.0) -> Path:
        package = self.dist / f"fishd_{version}-1~{suffix}.deb"
        package.touch()
        os.utime(package, (1e9 - age_s, 1e9 - age_s))
        return package

    def install(self, **variables: str) -> subprocess.CompletedProcess[str]:
        environment = {"DISK": str(self.disk), "LOG": str(self.log), "MACHINE": "arm64"}
        environment |= {"POLICY": POLICY, "PATH": f"{self.dist.parent}/bin:/usr/bin:/bin"}
        return call(self.dist.parent / "tools/install_pi.sh", env=environment | variables)

    def commands(self) -> list[str]:
        """Return the commands that changed the system."""
        lines = self.log.read_text().splitlines()
        return [line for line in lines if not re.search("is-active| policy |^dpkg", line)]


@pytest.fixture
def pi(tmp_path: Path) -> Pi:
    return Pi(tmp_path)


def test_apt_installs_the_newest_package_for_this_system_then_bus_and_pigpiod_follow(
    pi: Pi,
) -> None:
    pi.set_model("Raspberry Pi 4 Model B Rev 1.4")
    newest = pi.add_package("0.1.0", "deb12_arm64")
    pi.add_package("0.2.0", "deb12_arm64", age_s=60.0)
    for suffix in ("deb13_arm64", "deb12_amd64"):
        pi.add_package("0.3.0", suffix)
    done = pi.install()
    assert (done.returncode, done.stderr) == (0, "")
    assert pi.commands() == [
        f"apt-get install --yes {newest}",
        "raspi-config nonint do_i2c 0",
        "apt-get install --yes pigpio",
        "systemctl --quiet enable pigpiod",
    ]
    assert pi.config.read_text() == f"[cm5]\ndtoverlay=dwc2\n\n[all]\n{BAUDRATE}\n"


@pytest.mark.parametrize(
    ("model", "debian", "policy"),
    [
        ("Raspberry Pi 5 Model B Rev 1.0", "12", POLICY),
        ("Raspberry Pi Compute Module 5 Rev 1.0", "12", POLICY),
        ("Raspberry Pi 4 Model B Rev 1.4", "13", ""),
        ("", "12", POLICY.replace("1.79-1", "(none)")),  # Debian: only another package suggests it
    ],
)
def test_the_kernel_drives_the_servo_where_pigpiod_cannot(
    pi: Pi, model: str, debian: str, policy: str
) -> None:
    if model:
        pi.set_model(model)
    pi.set_debian(debian)
    package = pi.add_package("0.1.0", f"deb{debian}_arm64")
    done = pi.install(POLICY=policy)
    assert (done.returncode, done.stderr) == (0, "")
    assert pi.commands() == [f"apt-get install --yes {package}", "raspi-config nonint do_i2c 0"]
    assert "the kernel drives the servo, as step 2b of docs/how-to/install.md says" in (done.stdout)


def test_a_speed_of_the_bus_that_is_set_stays(pi: Pi) -> None:
    pi.config.write_text("dtparam=i2c_arm_baudrate=100000\n")
    assert pi.install(FISHD_DEB=str(pi.add_package("0.1.0", "any"))).returncode == 0
    assert pi.config.read_text() == "dtparam=i2c_arm_baudrate=100000\n"


@pytest.mark.parametrize(
    ("variables", "debian", "message"),
    [
        ({}, "12", "run make deb DEB_MACHINE=arm64 DEB_PYTHON=3.11, or name one with FISHD_DEB"),
        ({}, "13", "run make deb DEB_MACHINE=arm64 DEB_PYTHON=3.13, or name one with FISHD_DEB"),
        ({}, "11", "this is release 11; Debian or Raspberry Pi OS 12 or 13 is needed"),
        ({"MACHINE": "armhf"}, "12", "armhf; install the 64-bit edition of Raspberry Pi OS"),
        ({"FISHD_DEB": "/nowhere/fishd.deb"}, "12", "/nowhere/fishd.deb does not exist"),
        ({"DISK": ""}, "12", "needs root: run it with sudo"),
    ],
)
def test_where_nothing_can_be_installed_one_line_says_why(
    pi: Pi, variables: dict[str, str], debian: str, message: str
) -> None:
    if variables.get("DISK") == "" and os.geteuid() == 0:
        pytest.skip("this user is root")
    pi.set_debian(debian)
    done = pi.install(**variables)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("install_pi.sh: ")
    assert message in line


def test_shellcheck_has_nothing_to_say_against_the_scripts() -> None:
    if shutil.which("shellcheck") is None:
        pytest.skip("shellcheck is not installed: apt install shellcheck")
    done = call("shellcheck", *sorted((ROOT / "tools").glob("*.sh")))
    assert done.stdout + done.stderr == ""
