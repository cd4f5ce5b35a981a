"""fishd as installed from a wheel, without the checkout: its files, and its hints about extras."""

import os
import shutil
import sys
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from rigs.documents import ROOT
from rigs.once import once
from rigs.processes import call
from rigs.wheel import build

EXAMPLES = sorted(path.stem for path in (ROOT / "config").glob("*.yaml"))


@pytest.fixture(scope="session")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder into which pip has installed the wheel, without the packages that it needs."""

    def make(folder: Path) -> Path:
        target = folder / "site-packages"
        pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
        done = call(*pip, "--no-compile", "--target", target, build(folder))
        assert done.returncode == 0, done.stderr
        return target

    return once(tmp_path_factory, "installed-wheel", make)


def run(installed: Path, program: str, *arguments: str, folder: Path) -> CompletedProcess[str]:
    start = f"from fishd.__main__ import {program}; {program}()"
    return call(
        *[sys.executable, "-c", start, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(installed)},
    )


def test_it_brings_the_examples_of_configurations(installed: Path, tmp_path: Path) -> None:
    listed = run(installed, "fishctl", "config", "example", folder=tmp_path)
    assert [row.split()[0] for row in listed.stdout.splitlines()] == EXAMPLES
    written = run(
        installed, "fishctl", "config", "example", "simulated", "--to", "a.yaml", folder=tmp_path
    )
    assert written.stdout == "a.yaml: written\n"
    assert (tmp_path / "a.yaml").read_text() == (ROOT / "config" / "simulated.yaml").read_text()
    again = run(
        installed, "fishctl", "config", "example", "harsh", "--to", "a.yaml", folder=tmp_path
    )
    assert again.stderr == "fishctl: a.yaml: exists already; name another file with --to\n"


def test_an_unknown_example_gets_the_nearest_name(installed: Path, tmp_path: Path) -> None:
    done = run(installed, "fishctl", "config", "example", "simulate", folder=tmp_path)
    assert (done.returncode, done.stdout) == (78, "")
    assert done.stderr == ("fishctl: no example is named 'simulate'; did you mean 'simulated'?\n")


def test_a_fish_swims_the_shipped_policy(installed: Path, tmp_path: Path) -> None:
    arguments = ["simulate", "ppo", "--policy", "default-fish", "--seconds", "30", "--json"]
    done = run(installed, "fishctl", *arguments, folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")


def test_it_brings_the_units_of_systemd(installed: Path) -> None:
    shipped = installed / "fishd" / "shipped" / "systemd"
    units = [path.name for path in (ROOT / "systemd").iterdir()]
    assert sorted(path.name for path in shipped.iterdir()) == sorted(units)


def test_a_missing_extra_of_the_debian_package_gets_an_environment_of_its_own(
    installed: Path, tmp_path: Path
) -> None:
    (info,) = installed.glob("fishd-*.dist-info")
    without = shutil.ignore_patterns("direct_url.json")
    copy = shutil.copytree(info, tmp_path / info.name, ignore=without)
    (copy / "INSTALLER").write_text("dpkg\n")
    start = "from fishd.core.errors import install_command; print(install_command('lab'))"
    path = f"{tmp_path}:{installed}"
    done = call(sys.executable, "-c", start, cwd=tmp_path, env=os.environ | {"PYTHONPATH": path})
    assert done.stdout == "python3 -m venv ~/fishd && ~/fishd/bin/pip install 'fishd[lab]'\n"


def test_a_missing_extra_is_installed_from_where_the_wheel_was(
    installed: Path, tmp_path: Path
) -> None:
    start = "from fishd.core.errors import install_command; print(install_command('lab'))"
    done = call(
        *[sys.executable, "-c", start],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(installed)},
    )
    assert done.stdout.startswith(f"{sys.executable} -m pip install '/")
    assert done.stdout.endswith(".whl[lab]'\n")
