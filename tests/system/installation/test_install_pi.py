"""make install-pi and uninstall-pi, into a folder: files they write, keep and remove."""

import io
import os
import re
import shutil
import socket
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from rigs.documents import ROOT as CHECKOUT
from rigs.once import once
from rigs.processes import call
from rigs.wheel import build

CONFIG = "etc/fishd/fishd.yaml"
AS_INSTALLED = "opt/fishd/fishd.yaml.installed"


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return once(tmp_path_factory, "wheel", build)


class Pi:
    """Folder that replaces the disk of a Pi."""

    def __init__(self, disk: Path, wheel: Path) -> None:
        self.disk = disk
        self._wheel = wheel

    def run(self, *words: str, **variables: str) -> list[str]:
        """Run a script, or one step of the installation, without a network; return its output."""
        done = self.attempt(*words, **variables)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        return done.stdout.splitlines()

    def attempt(self, *words: str, **variables: str) -> subprocess.CompletedProcess[str]:
        """Run a script, or a function of install_pi.sh with arguments; it may fail."""
        environment = {**os.environ, "DESTDIR": str(self.disk), "PYTHON": sys.executable}
        environment |= {"FISHD_WHEEL": str(self._wheel), "PIP_NO_INDEX": "1", "PIP_NO_DEPS": "1"}
        environment |= {"FISHD_GPIO": "none", "PIP_COMPILE": "0", "PIP_NO_CACHE_DIR": "1"}
        command = [str(CHECKOUT / "tools" / words[0])]
        if not words[0].endswith(".sh"):  # sourced, the script only defines its functions
            step = f'source {CHECKOUT}/tools/install_pi.sh; workspace=$(mktemp -d); "$@"'
            command = ["bash", "-c", f"{step}; rm -r $workspace", "install_pi.sh", *words]
        options = {"capture_output": True, "text": True, "check": False, "timeout": 300}
        return subprocess.run(command, env=environment | variables, **options)

    def copy(self, folder: Path) -> "Pi":
        shutil.copytree(self.disk, folder, symlinks=True, copy_function=self._copy_or_link)
        return Pi(folder, self._wheel)

    def _copy_or_link(self, source: str, target: str) -> None:
        """Copy a file, or link it in packages, whose files pip and Python only replace."""
        copy = os.link if "/site-packages/" in source else shutil.copy2
        copy(source, target)


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Pi:
    """Return an installation over an earlier one whose Python no longer exists."""

    def make(folder: Path) -> Pi:
        pi = Pi(folder / "disk", wheel)
        left = pi.disk / "opt/fishd"
        for name in ("python", "python3", f"python3.{sys.version_info[1]}"):
            (left / "bin").mkdir(parents=True, exist_ok=True)
            (left / "bin" / name).symlink_to("/nowhere/python3")
        (left / "lib/python3.9/site-packages/fishd").mkdir(parents=True)
        assert pi.run("install_pi.sh")[0].startswith("/opt/fishd: made with Python 3.")
        return pi

    return once(tmp_path_factory, "installed", make)


@pytest.fixture
def pi(installed: Pi, tmp_path: Path) -> Pi:
    """Return a copy of the installation for one test."""
    return installed.copy(tmp_path / "pi")


def files(disk: Path) -> set[str]:
    """Return all files and links, except the files that Python compiles by itself."""
    paths = (path for path in disk.rglob("*") if path.is_symlink() or path.is_file())
    return {str(path.relative_to(disk)) for path in paths if "__pycache__" not in path.parts}


def test_what_is_installed_is_where_the_units_look_for_it(installed: Pi) -> None:
    for unit in ("fishd.service", "fishd-failure.service"):
        text = (installed.disk / "etc/systemd/system" / unit).read_text()
        commands = re.findall(r"^Exec\w+=[-+]*/(opt/\S+) --config /(\S+)$", text, re.MULTILINE)
        assert commands
        for program, config in commands:
            assert os.access(installed.disk / program, os.X_OK), program
            assert config == CONFIG
    assert (installed.disk / CONFIG).read_text() == (CHECKOUT / "config/pi.yaml").read_text()
    assert (installed.disk / "usr/local/bin/fishctl").readlink() == Path("/opt/fishd/bin/fishctl")


def test_the_installed_programs_run_from_their_final_place(installed: Pi) -> None:
    first = (installed.disk / "opt/fishd/bin/fishd").read_text().partition("\n")[0]
    assert first.startswith("#!/opt/fishd/bin/python")
    python = installed.disk / "opt/fishd/bin/python"
    where = subprocess.check_output([python, "-I", "-c", "import fishd; print(fishd.__file__)"])
    assert str(installed.disk) in where.decode()


def test_the_settings_of_the_camera_are_not_for_every_user(pi: Pi) -> None:
    camera = pi.disk / "etc/fishd/camera.yaml"
    assert camera.stat().st_mode & 0o777 == 0o640
    camera.write_text("source: stream\nstream: {url: 'rtsp://me:secret@host/'}\n")
    camera.chmod(0o644)  # as an older version had installed it
    text = "\n".join(pi.run("install_config"))
    assert camera.stat().st_mode & 0o777 == 0o640
    assert "camera.yaml: for root and group fishd only, as it may hold a camera's password" in text
    # The group that it gets when that exists.
    lines = (pi.disk / "etc/tmpfiles.d/fishd.conf").read_text().splitlines()
    assert "z /etc/fishd/camera.yaml 0640 root fishd -" in lines


def test_every_file_under_systemd_is_installed(installed: Pi) -> None:
    shipped = {path.name for path in (CHECKOUT / "systemd").rglob("*") if path.is_file()}
    assert shipped <= {Path(name).name for name in files(installed.disk)}


def test_installing_again_adds_nothing_and_says_what_is_missing(pi: Pi, tmp_path: Path) -> None:
    before = files(pi.disk)
    sdist(tmp_path / "sources", "rpi_lgpio", 'raise SystemExit("error: swig failed")')
    options = {"FISHD_GPIO": "rpi-lgpio", "PIP_FIND_LINKS": str(tmp_path / "sources")}
    lines = pi.run("install_pi.sh", **options)
    assert files(pi.disk) == before
    assert lines[0].startswith("/opt/fishd: has Python 3.")
    text = "\n".join(lines)
    assert "E-stop button and status light are NOT available: no rpi-lgpio" in text
    assert "sudo apt install swig gcc python3-dev; then: sudo make install-pi" in text
    assert "network" not in text
    assert "/etc/systemd/system/fishd.service: installed" in text


@pytest.mark.parametrize("renewed", [False, True])
def test_an_edited_config_is_kept_and_a_new_default_lies_beside_it(pi: Pi, renewed: bool) -> None:
    (pi.disk / CONFIG).write_text("robot: simulated\n")
    if renewed:
        (pi.disk / AS_INSTALLED).write_text("# what an older version had installed\n")
    (report,) = (line for line in pi.run("install_config") if line.startswith(f"/{CONFIG}: "))
    kept = "/etc/fishd/fishd.yaml: yours, kept"
    news = "; what is new is in /etc/fishd/fishd.yaml.new"
    assert report == (kept + news if renewed else kept)
    assert (pi.disk / CONFIG).read_text() == "robot: simulated\n"
    new = pi.disk / f"{CONFIG}.new"
    assert new.exists() is renewed
    if renewed:
        assert new.read_text() == (CHECKOUT / "config/pi.yaml").read_text()


def test_a_config_that_nobody_edited_is_renewed(pi: Pi) -> None:
    for name in (CONFIG, AS_INSTALLED):
        (pi.disk / name).write_text("# what an older version had installed\n")
    pi.run("install_config")
    assert (pi.disk / CONFIG).read_text() == (CHECKOUT / "config/pi.yaml").read_text()


def test_a_python_that_is_gone_is_replaced(installed: Pi) -> None:
    python = installed.disk / "opt/fishd/bin/python3"
    subprocess.run([python, "-I", "-c", "import fishd"], check=True)
    assert not (installed.disk / "opt/fishd/lib/python3.9").exists()


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
        done = call(
            *(drop if os.geteuid() == 0 else []),
            *("bash", "-s", script),
            input=f"source {CHECKOUT}/tools/pi_layout.sh; need_root",
            env={"PATH": os.environ["PATH"]},
        )
        assert done.returncode == 1
        assert "needs root: run it with sudo" in done.stderr


def run_function(function: str, *arguments: str) -> str:
    """Return the output of a function of the script, which only defines functions if sourced."""
    script = f'source {CHECKOUT}/tools/install_pi.sh; {function} "$@"'
    return call("bash", "-c", script, "bash", *arguments, check=True).stdout.strip()


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
    assert run_function("gpio_extra", model, debian, kernel) == extra


def wheel_of(folder: Path, name: str) -> Path:
    """Build a package that provides RPi; return its path."""
    path = folder / f"{name}-0.6-py3-none-any.whl"
    info = f"{name}-0.6.dist-info/"
    files = {
        "RPi/__init__.py": "",
        info + "METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.6\n",
        info + "WHEEL": "Wheel-Version: 1.0\nTag: py3-none-any\n",
    }
    files[info + "RECORD"] = "".join(f"{name},,\n" for name in (*files, info + "RECORD"))
    with zipfile.ZipFile(path, "w") as wheel:
        for name, text in files.items():
            wheel.writestr(name, text)
    return path


def sdist(folder: Path, name: str, build: str, requires: str = "") -> None:
    """Write sources of that package: `build` is code of its build, `requires` a quoted name."""
    folder.mkdir(exist_ok=True)
    built = wheel_of(folder.parent, name)
    backend = f"""
import os, shutil

def build_wheel(folder, settings=None, metadata=None):
    {build}
    shutil.copy({str(built)!r}, folder)
    return {built.name!r}
"""
    files = {
        "backend.py": backend,
        "pyproject.toml": f'[build-system]\nrequires = [{requires}]\nbuild-backend = "backend"\n'
        'backend-path = ["."]\n',
        "PKG-INFO": f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.6\n",
    }
    with tarfile.open(folder / f"{name}-0.6.tar.gz", "w:gz") as tar:
        for path, text in files.items():
            info = tarfile.TarInfo(f"{name}-0.6/{path}")
            info.size = len(text.encode())
            tar.addfile(info, io.BytesIO(text.encode()))


def test_a_gpio_package_is_built_and_only_then_the_other_goes(pi: Pi, tmp_path: Path) -> None:
    sources, install = tmp_path / "sources", ("install_gpio", "rpi-lgpio")
    (site,) = (pi.disk / "opt/fishd/lib").glob("python3*/site-packages")
    with zipfile.ZipFile(wheel_of(tmp_path, "RPi.GPIO")) as archive:
        archive.extractall(site)
    sdist(sources, "rpi_lgpio", 'raise SystemExit("error: swig failed")')
    pi.run(*install, PIP_FIND_LINKS=str(sources))
    assert (site / "RPi.GPIO-0.6.dist-info").exists()
    sdist(sources, "rpi_lgpio", 'assert os.environ["PYPI"] == "1"')
    lines = pi.run(*install, PIP_FIND_LINKS=str(sources))
    assert "RPi.GPIO: removed, it excludes rpi-lgpio" in lines
    assert "rpi-lgpio: installed, for E-stop button and status light" in lines
    assert not (site / "RPi.GPIO-0.6.dist-info").exists()
    subprocess.run([pi.disk / "opt/fishd/bin/python", "-I", "-c", "import RPi"], check=True)
    # The second time it is installed already, and is neither fetched nor built.
    assert "rpi-lgpio: there, for E-stop button and status light" in pi.run(*install)


def test_a_network_that_fails_is_not_taken_for_a_missing_compiler(pi: Pi, tmp_path: Path) -> None:
    install = ("install_gpio", "rpi-lgpio")
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))  # bound but not listening: connections are refused
        index = f"http://127.0.0.1:{bound.getsockname()[1]}/simple"
        options = {"PIP_NO_INDEX": "0", "PIP_INDEX_URL": index, "PIP_EXTRA_INDEX_URL": ""}
        options |= {"PIP_FIND_LINKS": "", "PIP_RETRIES": "1", "PIP_CONFIG_FILE": os.devnull}
        optional = "\n".join(pi.run(*install, **options))
        sdist(tmp_path / "sources", "rpi_lgpio", "pass", requires='"setuptools"')
        links = {"PIP_FIND_LINKS": str(tmp_path / "sources")}
        half = "\n".join(pi.run(*install, **options | links))
        needed = pi.attempt("install_package", **options | {"PIP_NO_DEPS": "0"})
    assert "NOT available" in optional
    assert "NOT available" in half
    assert needed.returncode == 1
    for said in (optional, half, needed.stderr.splitlines()[-1]):
        assert "the network failed" in said
        assert "apt install" not in said


def test_a_package_with_another_hash_than_the_locked_one_is_refused(pi: Pi, tmp_path: Path) -> None:
    wheel_of(tmp_path, "rpi_lgpio")  # its version is the locked one
    options = {"PIP_NO_INDEX": "0", "PIP_INDEX_URL": tmp_path.as_uri()}
    options |= {"PIP_EXTRA_INDEX_URL": "", "PIP_CONFIG_FILE": os.devnull}
    options |= {"PIP_FIND_LINKS": str(tmp_path)}
    lines = "\n".join(pi.run("install_gpio", "rpi-lgpio", **options))
    assert "a package is another file than that of tools/locks: do not trust it" in lines
    lines = "\n".join(pi.run("install_gpio", "rpi-lgpio", FISHD_LOCK="no", **options))
    assert "rpi-lgpio: installed" in lines


@pytest.mark.parametrize(
    ("bits", "platform", "extras"),
    [
        ("64", "linux-aarch64", "pi,record,policy"),
        ("64", "linux-x86_64", "pi,record,policy"),
        ("32", "linux-aarch64", "pi"),  # 32-bit Raspberry Pi OS on a Pi 4: the kernel has 64
        ("32", "linux-armv7l", "pi"),
        ("64", "linux-riscv64", "pi"),
    ],
)
def test_policies_and_recordings_are_for_a_python_of_64_bits(
    bits: str, platform: str, extras: str
) -> None:
    assert run_function("core_extras", bits, platform) == extras


def test_it_is_the_interpreter_that_is_asked_for_its_bits(tmp_path: Path) -> None:
    python = tmp_path / "python3"
    narrow = "import struct, sys; struct.calcsize = lambda form: 4; exec(sys.argv.pop(2))"
    python.write_text(f"#!/bin/sh\nexec {sys.executable} -c '{narrow}' \"$@\"\n")
    python.chmod(0o755)
    assert run_function("about_python", str(python)).startswith("32 linux-")


def test_no_driver_brings_a_gpio_package_along_by_itself(wheel: Path) -> None:
    """Require Adafruit-Blinka 10: before, it needs RPi.GPIO and lgpio, which exclude rpi-lgpio."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("dist-info/METADATA"))
        metadata = archive.read(name).decode()
    pattern = r"^Requires-Dist: ([\w.-]+)(\S*); extra == 'pi'$"
    wanted = {name.lower(): bounds for name, bounds in re.findall(pattern, metadata, re.MULTILINE)}
    assert "pigpio" in wanted
    assert ">=10" in wanted["adafruit-blinka"]


def test_an_unknown_gpio_package_is_refused_before_anything(wheel: Path, tmp_path: Path) -> None:
    done = Pi(tmp_path, wheel).attempt("install_pi.sh", FISHD_GPIO="gpio")
    assert done.returncode == 1
    assert done.stderr == "install_pi.sh: FISHD_GPIO=gpio: rpi-gpio, rpi-lgpio or none\n"
    assert files(tmp_path) == set()


def test_shellcheck_has_nothing_to_say_against_the_scripts() -> None:
    if shutil.which("shellcheck") is None:
        pytest.skip("shellcheck is not installed: apt install shellcheck")
    scripts = ["tools/install_pi.sh", "tools/uninstall_pi.sh", "tools/arm64_trial.sh"]
    done = call("shellcheck", "-x", *scripts, cwd=CHECKOUT)
    assert done.stdout + done.stderr == ""
