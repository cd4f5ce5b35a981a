"""make install-pi and uninstall-pi, into a folder: what they put, keep and take away."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
CONFIG = "etc/fishd/fishd.yaml"
AS_INSTALLED = "opt/fishd/fishd.yaml.installed"


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "wheel", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, f"--wheel-dir={folder}", CHECKOUT], check=True, capture_output=True)
    return next(folder.glob("fishd-*.whl"))


class Pi:
    """A folder that stands for the disk of a Pi."""

    def __init__(self, disk: Path, wheel: Path) -> None:
        self.disk = disk
        self._wheel = wheel

    def run(self, script: str, **variables: str) -> list[str]:
        """Run a script without a network; the lines that it says."""
        environment = {**os.environ, "DESTDIR": str(self.disk), "PYTHON": sys.executable}
        environment |= {"FISHD_WHEEL": str(self._wheel), "PIP_NO_INDEX": "1", "PIP_NO_DEPS": "1"}
        done = subprocess.run(
            [CHECKOUT / "tools" / script],
            env=environment | variables,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        return done.stdout.splitlines()

    def copy(self, folder: Path) -> "Pi":
        shutil.copytree(self.disk, folder, symlinks=True)
        return Pi(folder, self._wheel)


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Pi:
    pi = Pi(tmp_path_factory.mktemp("pi"), wheel)
    pi.run("install_pi.sh")
    return pi


@pytest.fixture
def pi(installed: Pi, tmp_path: Path) -> Pi:
    """As after a first installation."""
    return installed.copy(tmp_path / "pi")


def files(disk: Path) -> set[str]:
    """All that is no folder; what Python compiles by itself does not count."""
    found = (path for path in disk.rglob("*") if path.is_symlink() or path.is_file())
    return {str(path.relative_to(disk)) for path in found if "__pycache__" not in path.parts}


def test_what_is_installed_is_where_the_units_look_for_it(pi: Pi) -> None:
    unit = (pi.disk / "etc/systemd/system/fishd.service").read_text()
    for program in ("opt/fishd/bin/fishd", "opt/fishd/bin/fishctl"):
        assert f"/{program} " in unit
        assert os.access(pi.disk / program, os.X_OK)
    assert f"--config /{CONFIG}" in unit
    assert (pi.disk / CONFIG).read_text() == (CHECKOUT / "config/pi.yaml").read_text()
    assert (pi.disk / "usr/local/bin/fishctl").readlink() == Path("/opt/fishd/bin/fishctl")


def test_the_installed_programs_run_from_their_final_place(pi: Pi) -> None:
    first = (pi.disk / "opt/fishd/bin/fishd").read_text().partition("\n")[0]
    assert first.startswith("#!/opt/fishd/bin/python")
    python = pi.disk / "opt/fishd/bin/python"
    where = subprocess.check_output([python, "-I", "-c", "import fishd; print(fishd.__file__)"])
    assert str(pi.disk) in where.decode()


def test_every_file_under_systemd_is_installed(pi: Pi) -> None:
    shipped = {path.name for path in (CHECKOUT / "systemd").rglob("*") if path.is_file()}
    assert shipped <= {Path(name).name for name in files(pi.disk)}


def test_installing_twice_changes_nothing(pi: Pi) -> None:
    before = files(pi.disk)
    said = pi.run("install_pi.sh")
    assert files(pi.disk) == before
    assert said[0].startswith("/opt/fishd: has Python 3.")


def test_an_edited_config_is_kept(pi: Pi) -> None:
    (pi.disk / CONFIG).write_text("robot: simulated\n")
    assert "/etc/fishd/fishd.yaml: yours, kept" in pi.run("install_pi.sh")
    assert (pi.disk / CONFIG).read_text() == "robot: simulated\n"
    assert not (pi.disk / f"{CONFIG}.new").exists()


def test_a_new_default_config_lies_beside_an_edited_one(pi: Pi) -> None:
    (pi.disk / CONFIG).write_text("robot: simulated\n")
    (pi.disk / AS_INSTALLED).write_text("# what an older version had installed\n")
    said = [line for line in pi.run("install_pi.sh") if ".new" in line]
    assert said == [
        "/etc/fishd/fishd.yaml: yours, kept; what is new is in /etc/fishd/fishd.yaml.new"
    ]
    assert (pi.disk / CONFIG).read_text() == "robot: simulated\n"
    assert (pi.disk / f"{CONFIG}.new").read_text() == (CHECKOUT / "config/pi.yaml").read_text()


def test_a_config_that_nobody_edited_is_renewed(pi: Pi) -> None:
    for name in (CONFIG, AS_INSTALLED):
        (pi.disk / name).write_text("# what an older version had installed\n")
    pi.run("install_pi.sh")
    assert (pi.disk / CONFIG).read_text() == (CHECKOUT / "config/pi.yaml").read_text()


def test_a_python_that_is_gone_is_replaced(pi: Pi) -> None:
    python = pi.disk / "opt/fishd/bin/python3"
    version = pi.disk / f"opt/fishd/bin/python3.{sys.version_info[1]}"
    for link in (python, version, pi.disk / "opt/fishd/bin/python"):
        link.unlink(missing_ok=True)
        link.symlink_to("/nowhere/python3")
    assert pi.run("install_pi.sh")[0].startswith("/opt/fishd: made with Python 3.")
    subprocess.run([python, "-I", "-c", "import fishd"], check=True)


def test_uninstalling_leaves_nothing(pi: Pi) -> None:
    pi.run("uninstall_pi.sh")
    assert files(pi.disk) == set()


def test_uninstalling_keeps_an_edited_config_and_calibrations(pi: Pi) -> None:
    (pi.disk / CONFIG).write_text("robot: simulated\n")
    calibration = pi.disk / "var/lib/fishd/pi/force.yaml"
    calibration.parent.mkdir(parents=True)
    calibration.touch()
    pi.run("uninstall_pi.sh")
    assert files(pi.disk) == {CONFIG, str(calibration.relative_to(pi.disk))}
    pi.run("uninstall_pi.sh", PURGE="1")
    assert files(pi.disk) == set()


def test_without_root_and_without_a_folder_nothing_is_done() -> None:
    drop = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"]
    for script in ("install_pi.sh", "uninstall_pi.sh"):
        done = subprocess.run(
            [*(drop if os.geteuid() == 0 else []), "bash", "-s", script],
            input=f"source {CHECKOUT}/tools/pi_layout.sh; need_root",
            env={"PATH": os.environ["PATH"]},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 1
        assert "needs root: run it with sudo" in done.stderr


@pytest.mark.parametrize(
    ("model", "debian", "kernel", "extra"),
    [
        ("Raspberry Pi 4 Model B Rev 1.4", "12", "6.1.21-v8+", "rpi-gpio"),
        ("Raspberry Pi Zero 2 W Rev 1.0", "12", "5.15.84-v8+", "rpi-gpio"),
        ("Raspberry Pi 4 Model B Rev 1.4", "12", "6.6.31+rpt-rpi-v8", "rpi-lgpio"),
        ("Raspberry Pi 4 Model B Rev 1.4", "13", "6.1.21-v8+", "rpi-lgpio"),
        ("Raspberry Pi 5 Model B Rev 1.0", "12", "6.1.63-v8+", "rpi-lgpio"),
        ("Raspberry Pi Compute Module 5 Rev 1.0", "12", "6.1.63-v8+", "rpi-lgpio"),
        ("Raspberry Pi 500 Rev 1.0", "12", "6.1.63-v8+", "rpi-lgpio"),
        ("", "0", "7.0.0", "rpi-lgpio"),
    ],
)
def test_the_gpio_package_suits_the_pi(model: str, debian: str, kernel: str, extra: str) -> None:
    # Sourced, the script only defines its functions.
    script = f'source {CHECKOUT}/tools/install_pi.sh; gpio_extra "$@"'
    chosen = subprocess.check_output(
        ["bash", "-c", script, "bash", model, debian, kernel], text=True
    )
    assert chosen.strip() == extra


def test_an_unknown_gpio_package_is_refused_before_anything_is_done(tmp_path: Path) -> None:
    done = subprocess.run(
        [CHECKOUT / "tools/install_pi.sh"],
        env={
            **os.environ,
            "DESTDIR": str(tmp_path),
            "PYTHON": sys.executable,
            "FISHD_GPIO": "gpio",
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr == "install_pi.sh: FISHD_GPIO=gpio: rpi-gpio, rpi-lgpio or none\n"
    assert files(tmp_path) == set()


def test_shellcheck_has_nothing_to_say_against_the_scripts() -> None:
    if shutil.which("shellcheck") is None:
        pytest.skip("shellcheck is not installed: apt install shellcheck")
    scripts = ["tools/install_pi.sh", "tools/uninstall_pi.sh"]
    done = subprocess.run(
        ["shellcheck", "-x", *scripts], cwd=CHECKOUT, capture_output=True, text=True, check=False
    )
    assert done.stdout + done.stderr == ""
