"""The Debian package: version, files and scripts; `make trial-deb` installs it under systemd."""

import re
import subprocess
from pathlib import Path

import pytest
from rigs.documents import ROOT

from deb.package import (
    CONFIGS,
    HERE,
    HOME,
    SYSTEM_FILES,
    debian_version,
    install_system_files,
)

SYSTEM = {path for path in (ROOT / "systemd").rglob("*") if path.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("earlier", "later"),
    [
        (("0.1.0.dev7+g547eb82", "3.11"), ("0.1.0.dev8+g08095781", "3.11")),
        (("0.1.0.dev8+g08095781", "3.11"), ("0.1.0rc1", "3.11")),
        (("0.1.0rc1", "3.13"), ("0.1.0", "3.11")),
        (("0.1.0", "3.11"), ("0.1.0", "3.13")),
        (("0.1.0", "3.13"), ("0.1.1", "3.11")),
    ],
)
def test_dpkg_sorts_the_versions_as_they_follow(
    earlier: tuple[str, str], later: tuple[str, str]
) -> None:
    versions = [debian_version(*earlier), "lt", debian_version(*later)]
    subprocess.run(["dpkg", "--compare-versions", *versions], check=True)


def test_every_file_under_systemd_is_in_the_package(tmp_path: Path) -> None:
    matched = [path for pattern in SYSTEM_FILES for path in (ROOT / "systemd").glob(pattern)]
    assert sorted(matched) == sorted(SYSTEM)
    install_system_files(tmp_path)
    installed = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert installed == {path.name for path in SYSTEM} | {
        f"{name}.yaml" for name in CONFIGS.values()
    }


def test_its_units_start_the_programs_of_the_package(tmp_path: Path) -> None:
    install_system_files(tmp_path)
    units = [path.read_text() for path in tmp_path.rglob("fishd*.service")]
    commands = re.findall(r"^Exec\w+=[-+]*(/\S+/fishd\S*|/\S+/fishctl)", "\n".join(units), re.M)
    assert len(commands) >= 6
    assert {str(Path(command).parent) for command in commands} == {f"/{HOME}/bin"}
    for text in units:
        assert "/opt/fishd" not in text
        assert "install-pi" not in text


@pytest.mark.slow
def test_dash_can_read_the_scripts_of_the_package() -> None:
    for name in ("preinst", "postinst", "prerm", "postrm"):
        subprocess.run(["sh", "-n", HERE / name], check=True)
