"""Trials of the Debian package under a real systemd: install, upgrade, remove, purge.

Needs root, a network and Debian's packages debootstrap and systemd-container; some minutes.
"""

import shutil
import subprocess
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path

from common.report import BrokenPromise, Report, progress, table
from reliability.systemd import work_folder
from reliability.systemd.container import Container, wait_for
from reliability.systemd.root import (
    CHECKOUT,
    HOME,
    OPTIONS,
    PYTHONS,
    build_package,
    check_machine,
    make_debian,
)

_UNITS = ("fishd", "fishd-recorder", "fishd-camera", "fishd-window")
_FISHD = "fishd.service"

OPTIONS = OPTIONS | {
    "--suite": {"nargs": "+", "choices": PYTHONS, "default": [*PYTHONS], "help": "Debians to try"},
}


def measure(options: Namespace) -> Report:
    """Run every trial; raises `BrokenPromise`, and SystemExit where trials are not possible."""
    check_machine()
    for suite in options.suite:
        rows = _try_on(suite, options)
    text = f"On {' and '.join(options.suite)}:\n\n{table('action | outcome', rows)}"
    number = f"{len(rows)} actions as promised, on {' and '.join(options.suite)}"
    return Report({"reliability deb": text}, rows, number=number)


def _try_on(suite: str, options: Namespace) -> list[tuple[str, str]]:
    """Run every trial on a release of Debian, and return actions and outcomes."""
    rows = []
    with work_folder(options.keep) as work:
        root = make_debian(work, suite, options)
        package = build_package(work, suite)
        shutil.copy(package, root / "root" / "old.deb")
        shutil.copy(CHECKOUT / "tools" / "install_pi.sh", root / "root")
        _renumber(package, root / "root" / "new.deb", work)
        with Container(root) as container:
            for trial in TRIALS:
                rows.append((trial.__name__.strip("_").replace("_", " "), trial(container)))
                progress(suite, *rows[-1])
    return rows


def _renumber(package: Path, new: Path, work: Path) -> None:
    """Write the same package with a higher version."""
    folder = work / "new"
    subprocess.run(["dpkg-deb", "--raw-extract", package, folder], check=True)
    control = folder / "DEBIAN/control"
    control.write_text(control.read_text().replace("-1~deb", "-2~deb"))
    build = ["dpkg-deb", "--root-owner-group", "-Znone", "--build", folder, new]
    subprocess.run(build, check=True, stdout=subprocess.DEVNULL)
    shutil.rmtree(folder)


def _require(kept: bool, otherwise: str) -> None:
    if not kept:
        raise BrokenPromise(otherwise)


def _dpkg(container: Container, *words: str, check: bool = True) -> str:
    return container.run("env", "DEBIAN_FRONTEND=noninteractive", "dpkg", *words, check=check)


def _state(container: Container, unit: str) -> tuple[str, str]:
    return container.show(unit, "ActiveState"), container.show(unit, "UnitFileState")


def _pid(container: Container) -> str:
    return container.show(_FISHD, "MainPID")


def _upgrade_to(container: Container, package: str, *, restarts: bool) -> str:
    """Install a package over the other, and return its output."""
    before = _pid(container)
    said = _dpkg(container, "--install", f"/root/{package}.deb")
    restarted = _pid(container) != before
    _require(restarted == restarts, f"fishd {'is' if restarted else 'is not'} restarted: {said}")
    _require(container.show(_FISHD, "ActiveState") == "active", "fishd does not run")
    _require(restarts or "runs on" in said, f"the upgrade does not say that fishd runs on: {said}")
    return said


def _installing_beside_an_older_installation(container: Container) -> str:
    other = container.root / "opt/fishd/bin/fishd"
    other.parent.mkdir(parents=True)
    other.touch()
    said = container.run("sh", "-c", "dpkg --install /root/old.deb 2>&1 || true")
    shutil.rmtree(container.root / "opt/fishd")
    _require("sudo make uninstall-pi" in said, f"no remedy: {said}")
    _require(not (container.root / f"{HOME}/bin").exists(), "it is installed all the same")
    return "refused, with the remedy"


def _installing(container: Container) -> str:
    said = container.run("env", "FISHD_DEB=/root/old.deb", "/root/install_pi.sh")
    _require("step 2b of docs" in said, "it does not say that a Debian has no pigpiod")
    _require("systemctl enable --now fishd" in said, "it does not say how to start fishd")
    for unit in _UNITS:
        _require(_state(container, unit) == ("inactive", "disabled"), f"{unit} is started")
    container.run("fishctl", "--version")
    container.run("test", "-d", f"/{HOME}/lib")
    container.run("getent", "passwd", "fishd")
    camera = container.run("stat", "--format=%a %U %G", "/etc/fishd/camera.yaml")
    _require(camera == "640 root fishd", f"/etc/fishd/camera.yaml is {camera}")
    compiled = (container.root / HOME / "lib").glob("python*/site-packages/fishd/__pycache__")
    _require(any(compiled), "nothing is compiled")
    return "no service starts or is enabled"


def _starting(container: Container) -> str:
    config = (CHECKOUT / "config/simulated.yaml").read_text()
    (container.root / "etc/fishd/fishd.yaml").write_text(f"{config}state_folder: /var/lib/fishd\n")
    drop_in = container.root / "etc/systemd/system/fishd.service.d/trial.conf"
    drop_in.parent.mkdir()
    drop_in.write_text("[Service]\nLimitRTPRIO=0\nLimitMEMLOCK=64K\n")  # a container may not more
    container.run("systemctl", "daemon-reload")
    container.run("systemctl", "enable", "--now", "--quiet", *_UNITS[:2])
    _require(_state(container, _FISHD) == ("active", "enabled"), "fishd does not run")
    wait_for(
        lambda: any((container.root / "var/lib/fishd-recorder").rglob("*.mcap*")),
        "the black box records nothing",
    )
    return "fishd and its black box run"


def _upgrading_while_the_fish_swims(container: Container) -> str:
    container.run("fishctl", "set-controller", "swing")
    _upgrade_to(container, "new", restarts=False)
    return "the old fishd swims on, and the upgrade says so"


def _upgrading_after_an_emergency_stop(container: Container) -> str:
    container.run("fishctl", "estop")
    _upgrade_to(container, "old", restarts=False)
    container.run("fishctl", "clear-fault")
    return "the stop stays"


def _upgrading_while_the_fish_rests(container: Container) -> str:
    container.run("fishctl", "stop")
    wait_for(lambda: "idle" in container.run("fishctl", "status"), "the fish does not rest")
    _upgrade_to(container, "new", restarts=True)
    config = (container.root / "etc/fishd/fishd.yaml").read_text()
    _require(config.startswith((CHECKOUT / "config/simulated.yaml").read_text()), "config is gone")
    return "restarted; the edited configuration stays"


def _removing(container: Container) -> str:
    calibration = container.root / "var/lib/fishd/force.yaml"
    calibration.touch()
    _dpkg(container, "--remove", "fishd")
    for unit in _UNITS:
        _require(container.show(unit, "ActiveState") == "inactive", f"{unit} still runs")
    left = [path for path in (HOME, "usr/bin/fishctl") if (container.root / path).exists()]
    _require(not left, f"{', '.join(left)} stay")
    _require(calibration.exists(), "calibrations are gone")
    _require((container.root / "etc/fishd/fishd.yaml").exists(), "the configuration is gone")
    return "stopped; configuration and calibrations stay"


def _installing_again(container: Container) -> str:
    _dpkg(container, "--install", "/root/new.deb")
    _require(_state(container, _FISHD) == ("inactive", "disabled"), "fishd is started")
    container.run("systemctl", "start", "fishd")
    return "the configuration is as before"


def _purging(container: Container) -> str:
    said = _dpkg(container, "--purge", "fishd")
    for path in ("etc/fishd", "var/lib/fishd", "etc/systemd/system/fishd.service.d"):
        _require(not (container.root / path).exists(), f"/{path} stays")
    _require(container.show(_FISHD, "LoadState") == "not-found", "the unit stays")
    recordings = container.root / "var/lib/fishd-recorder"
    _require(any(recordings.rglob("*.mcap*")), "recordings are gone")
    _require("holds recordings, and stays" in said, "it does not say that recordings stay")
    return "only recordings stay, and it says so"


TRIALS: tuple[Callable[[Container], str], ...] = (
    _installing_beside_an_older_installation,
    _installing,
    _starting,
    _upgrading_while_the_fish_swims,
    _upgrading_after_an_emergency_stop,
    _upgrading_while_the_fish_rests,
    _removing,
    _installing_again,
    _purging,
)
